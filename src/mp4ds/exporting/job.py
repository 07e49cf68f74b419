"""What an export is made of."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mp4ds.dataset import Dataset
from mp4ds.exporting.cameras import Camera, chosen_cameras
from mp4ds.exporting.ledger import Ledger
from mp4ds.exporting.options import ExportOptions
from mp4ds.plan import Selection

_TELL_EVERY = 16  # frames


class Source:
    """A dataset that is exported.

    Attributes:
        dataset: The dataset.
        ledger: Counts its messages.
        cameras: Its chosen streams.
        notes: What the format does not say as it was recorded.
    """

    def __init__(self, dataset: Dataset, options: ExportOptions) -> None:
        dataset.verify_messages()
        self.dataset = dataset
        self.ledger = Ledger(dataset)
        self.notes: list[str] = []
        selected = Selection(options.topics, options.exclude)
        selected.check(channel.topic for channel in dataset.channels)
        named = {options.poses, options.state, options.action}
        self._selected = selected
        self._named = named
        streams = [stream for stream in dataset.streams if selected(stream.topic)]
        self.cameras = chosen_cameras(streams, options, self.ledger, self.notes)

    def chosen(self, topic: str) -> bool:
        """Whether a topic was asked for, by a glob or by its name."""
        return self._selected(topic) or topic in self._named


@dataclass
class Job:
    """An export that is being made.

    Attributes:
        path: Where to make it.
        target: What it will be called.
        options: How.
        sources: The datasets, one but for formats that hold several.
        tell: Called with a phrase now and then.
        places: Part of the output -> the topic that is in it.
    """

    path: Path
    target: Path
    options: ExportOptions
    sources: Sequence[Source]
    tell: Callable[[str], None]
    places: dict[str, str] = field(default_factory=dict)

    @property
    def source(self) -> Source:
        """The dataset, for formats that hold one."""
        return self.sources[0]

    def note(self, sentence: str) -> None:
        """Tell what the format does not say as it was recorded."""
        if sentence not in self.source.notes:
            self.source.notes.append(sentence)

    def write_png_files(self, camera: Camera, place: str, names: Sequence[str]) -> None:
        """Write the frames of a camera as PNG files, and count them.

        Args:
            camera: The camera.
            place: The part of the output that they are told to be in.
            names: Path of each frame's file from the output's folder.
        """
        folder = self.path / names[0].rpartition("/")[0] if names else self.path
        folder.mkdir(parents=True, exist_ok=True)
        files = camera.png_files()
        for position, data in self.counted(files, f"{camera.topic} as {place}", len(camera)):
            (self.path / names[position]).write_bytes(data)
        self.places[place] = camera.topic
        self.source.ledger.hold(camera.topic, len(camera))

    def counted(
        self, items: Iterator[tuple[int, bytes]], what: str, total: int
    ) -> Iterator[tuple[int, bytes]]:
        """The same items; tells how many there were now and then."""
        for number, item in enumerate(items):
            if number % _TELL_EVERY == 0:
                self.tell(f"{what}: frame {number} of {total}")
            yield item
