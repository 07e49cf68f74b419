"""A training epoch over recordings of two cameras: ``loader.py epoch``.

A PyTorch DataLoader gives shuffled batches of samples; a sample is the frame before, the frame and
the frame after it, of both cameras. The recordings are parts of the clip of loader_clips.py, the
same for all loaders:

- mp4ds: `mp4ds.torch.FrameDataset` over datasets of mp4ds, tensors of uint8, and of float32;
- lerobot: `LeRobotDataset` over a dataset that it made itself with its default encoding, float32;
- lerobot (emulated): where LeRobot is missing, or asked for; a torchcodec decoder for each of
  LeRobot's files, in the mode that LeRobot uses, float32, or uint8 as LeRobot 0.6 gives on request.

Each loader is a process of its own, with its workers. CPU time is that of all of them. Memory is
polled from outside: the largest sum over the processes of resident memory, and of the share of it
that is theirs (PSS), in the first epoch, and in each of the later ones.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from statistics import median
from typing import Any, Literal

from loader_clips import HERTZ, moving, write_cameras, write_lerobot_video
from loader_peers import allow_lerobot, installed
from measure import parse_size, print_table

CAMERAS = ("/left/image_raw", "/right/image_raw")
STEPS = (-1, 0, 1)
_TOLERANCE_NS = 10_000_000
_POLL_S = 0.25


def options(parser: argparse.ArgumentParser) -> None:
    """What can be chosen."""
    parser.add_argument("--loader", nargs="+", choices=LOADERS, help="all that can run by default")
    parser.add_argument("--episodes", type=int, default=6, help="recordings")
    parser.add_argument("--frames", type=int, default=300, help="of each camera of a recording")
    parser.add_argument("--size", type=parse_size, default=(640, 480), help="WxH")
    parser.add_argument("--gop", type=int, default=15, help="of ours, by default as for training")
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--batches", type=int, help="of an epoch; all by default")


def run(chosen: argparse.Namespace) -> None:
    """Measure and print."""
    made = Made(chosen.folder, chosen.episodes, chosen.frames, chosen.size, chosen.gop)
    loaders = chosen.loader or [name for name in LOADERS if _can_run(name)]
    print(
        f"- {chosen.episodes} recordings of two cameras, {chosen.frames} frames each of "
        f"{chosen.size[0]}x{chosen.size[1]}; {chosen.workers} workers, batches of {chosen.batch}",
        flush=True,
    )
    made.make(loaders)
    header = (
        *("loader", "MB", "samples/s", "samples per CPU s", "first batch, s"),
        *("peak, MB", "peak PSS, MB", "PSS of each epoch, MB"),
    )
    print_table(header, (_row(made, name, chosen) for name in loaders))


def _can_run(name: str) -> bool:
    if name.startswith("mp4ds"):
        return installed("mp4ds") is not None
    real = installed("lerobot") is not None
    return name == "lerobot, uint8 (emulated)" or real == (name == "lerobot")


class Made:
    """The recordings, stored for each loader.

    Args:
        folder: Where; one below it is made.
        episodes: How many recordings.
        frames: Of each camera of a recording.
        size: Width and height.
        gop: Of our videos.
    """

    def __init__(
        self, folder: Path, episodes: int, frames: int, size: Sequence[int], gop: int
    ) -> None:
        self.episodes, self.frames, self.size = episodes, frames, (size[0], size[1])
        self.gop = gop
        self.folder = folder / f"epoch-{size[0]}x{size[1]}-{episodes}x{frames}"

    @property
    def datasets(self) -> list[Path]:
        """Ours."""
        folder = self.folder / f"mp4ds-{self.gop}"
        return [folder / f"{number:03}" for number in range(self.episodes)]

    @property
    def videos(self) -> list[list[Path]]:
        """For each recording, a file of each camera, as LeRobot encodes it."""
        folder = self.folder / "emulated"
        return [
            [folder / f"{number:03}-{place}.mp4" for place in range(len(CAMERAS))]
            for number in range(self.episodes)
        ]

    @property
    def lerobot(self) -> Path:
        """The dataset that LeRobot made."""
        return self.folder / "lerobot"

    def clips(self, number: int) -> dict[str, Iterable[Any]]:
        """The frames of a recording's cameras."""
        first = number * len(CAMERAS)
        return {
            topic: moving(self.frames, self.size, seed=1 + first + place)
            for place, topic in enumerate(CAMERAS)
        }

    def make(self, loaders: Sequence[str]) -> None:
        """Make what is missing."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if any(name.startswith("mp4ds") for name in loaders):
            for number, path in enumerate(self.datasets):
                self._make_dataset(number, path)
        if any("emulated" in name for name in loaders):
            for number, paths in enumerate(self.videos):
                for path, frames in zip(paths, self.clips(number).values(), strict=True):
                    if not path.exists():
                        path.parent.mkdir(exist_ok=True)
                        part = path.with_suffix(".part.mp4")
                        write_lerobot_video(part, frames)
                        part.rename(path)
        if "lerobot" in loaders and not self.lerobot.exists():
            self._make_lerobot()

    def _make_dataset(self, number: int, path: Path) -> None:
        import mp4ds

        if path.exists():
            return
        recording = self.folder / "recording.mcap"
        write_cameras(recording, self.clips(number), "rgb8")
        path.parent.mkdir(exist_ok=True)
        # with 15 frames, what `--for training` makes
        options = mp4ds.PackOptions(quality="crf=30", codec="av1", preset="4", gop=self.gop)
        mp4ds.pack(recording, path, options)
        recording.unlink()

    def _make_lerobot(self) -> None:
        operators = allow_lerobot()
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        width, height = self.size
        names = ["height", "width", "channels"]
        features = {
            _feature(topic): {"dtype": "video", "shape": (height, width, 3), "names": names}
            for topic in CAMERAS
        }
        part = self.lerobot.with_suffix(".part")
        dataset = LeRobotDataset.create(
            "benchmark/clip", HERTZ, features, root=part, image_writer_threads=2
        )
        for number in range(self.episodes):
            clips = self.clips(number)
            for images in zip(*clips.values(), strict=True):
                frame = dict(zip(map(_feature, clips), images, strict=True))
                dataset.add_frame({**frame, "task": "none"})
            dataset.save_episode()
        dataset.finalize()
        part.rename(self.lerobot)
        del operators

    def megabytes(self, loader: str) -> float:
        """Of what a loader reads."""
        if loader.startswith("mp4ds"):
            roots = self.datasets
        else:
            roots = [self.lerobot if loader == "lerobot" else self.videos[0][0].parent]
        files = (file for root in roots for file in root.rglob("*") if file.is_file())
        return sum(file.stat().st_size for file in files) / 1e6


def _feature(topic: str) -> str:
    return f"observation.images.{topic.split('/')[1]}"


# ---------------------------------------------------------------- loaders


def _ours(made: Made, dtype: Literal["uint8", "float32"]) -> Any:
    from mp4ds.torch import FrameDataset

    return FrameDataset(
        made.datasets,
        topics=list(CAMERAS),
        offsets=STEPS,
        sync_tolerance_ns=_TOLERANCE_NS,
        dtype=dtype,
    )


def _lerobot(made: Made) -> Any:
    operators = allow_lerobot()
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    around = {_feature(topic): [step / HERTZ for step in STEPS] for topic in CAMERAS}
    dataset = LeRobotDataset("benchmark/clip", root=made.lerobot, delta_timestamps=around)
    dataset.operators = operators
    return dataset


class EmulatedLeRobot:
    """LeRobot's videos, read as LeRobot reads them; a map-style dataset.

    Args:
        made: The recordings.
        floats: Whether to convert to 0 to 1.
    """

    def __init__(self, made: Made, *, floats: bool) -> None:
        self._videos, self._frames, self._floats = made.videos, made.frames, floats
        self._decoders: dict[Path, Any] = {}

    def __len__(self) -> int:
        return len(self._videos) * self._frames

    def __getitem__(self, index: int) -> dict[str, Any]:
        recording, number = divmod(index, self._frames)
        wanted = [min(max(number + step, 0), self._frames - 1) for step in STEPS]
        return {
            topic: self._read(path, wanted)
            for topic, path in zip(CAMERAS, self._videos[recording], strict=True)
        }

    def _read(self, path: Path, wanted: list[int]) -> Any:
        import torch
        from torchcodec.decoders import VideoDecoder

        if path not in self._decoders:
            self._decoders[path] = VideoDecoder(str(path), seek_mode="approximate")
        frames = torch.stack(list(self._decoders[path].get_frames_at(wanted).data))
        return (frames / 255.0).type(torch.float32) if self._floats else frames


LOADERS: dict[str, Callable[[Made], Any]] = {
    "mp4ds": lambda made: _ours(made, "uint8"),
    "mp4ds, float32": lambda made: _ours(made, "float32"),
    "lerobot": _lerobot,
    "lerobot (emulated)": lambda made: EmulatedLeRobot(made, floats=True),
    "lerobot, uint8 (emulated)": lambda made: EmulatedLeRobot(made, floats=False),
}


def epochs(chosen: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """What each epoch took; at last the CPU seconds of this process and its workers."""
    os.environ["HF_HUB_OFFLINE"] = "1"
    import torch
    from torch.utils.data import DataLoader

    made = Made(
        Path(chosen["folder"]), chosen["episodes"], chosen["frames"], chosen["size"], chosen["gop"]
    )
    dataset = LOADERS[chosen["loader"]](made)
    loader: Any = DataLoader(
        dataset,
        batch_size=chosen["batch"],
        shuffle=True,
        num_workers=chosen["workers"],
        persistent_workers=chosen["workers"] > 0,
        generator=torch.Generator().manual_seed(0),
        collate_fn=getattr(dataset, "collate", None),
    )
    before = _cpu_seconds()
    for _ in range(chosen["epochs"]):
        start, first, samples = time.perf_counter(), 0.0, 0
        for batch in islice(loader, chosen["batches"]):
            first = first or time.perf_counter() - start
            pictures = next(value for value in batch.values() if _are_pictures(value))
            samples += len(pictures)
        yield {"wall": time.perf_counter() - start, "first": first, "samples": samples}
    del loader  # ends the workers, so that their time is known
    yield {"cpu": _cpu_seconds() - before}


def _are_pictures(value: Any) -> bool:
    return getattr(value, "ndim", 0) == 5


def _cpu_seconds() -> float:
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


# ---------------------------------------------------------------- from outside


def _row(made: Made, loader: str, chosen: argparse.Namespace) -> tuple[object, ...]:
    arguments = {
        "folder": str(chosen.folder),
        "loader": loader,
        "size": list(made.size),
        **{
            name: getattr(chosen, name)
            for name in ("episodes", "frames", "gop", "epochs", "batch", "workers", "batches")
        },
    }
    lines, memory, error = _watched([sys.executable, __file__, json.dumps(arguments)])
    if not lines or "cpu" not in lines[-1]:
        return loader, "", f"failed: {error}", "", "", "", "", ""
    *rounds, last = lines
    later = rounds[1:] or rounds
    samples = sum(line["samples"] for line in rounds)
    memory = memory[: len(rounds)]  # until the end of each epoch
    each = [f"{max(pss for _, pss in polled) / 1e6:.0f}" for polled in memory if polled]
    polled = [pair for pairs in memory for pair in pairs]
    return (
        loader,
        f"{made.megabytes(loader):.1f}",
        f"{median(line['samples'] / line['wall'] for line in later):.1f}",
        f"{samples / last['cpu']:.1f}",
        f"{rounds[0]['first']:.2f}",
        f"{max(rss for rss, _ in polled) / 1e6:.0f}",
        f"{max(pss for _, pss in polled) / 1e6:.0f}",
        " ".join(each),
    )


def _watched(
    command: Sequence[str],
) -> tuple[list[dict[str, Any]], list[list[tuple[int, int]]], str]:
    """What a process prints, the memory polled before each line, and its last word if it failed."""
    import psutil

    lines: list[dict[str, Any]] = []
    memory: list[list[tuple[int, int]]] = [[]]
    errors: list[str] = []
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        out, err = process.stdout or (), process.stderr or ()
        readers = [
            threading.Thread(target=lambda: lines.extend(map(json.loads, out))),
            threading.Thread(target=lambda: errors.extend(err)),
        ]
        for reader in readers:
            reader.start()
        watched = psutil.Process(process.pid)
        while process.poll() is None:
            while len(memory) <= len(lines):
                memory.append([])
            memory[-1].append(_memory(watched))
            time.sleep(_POLL_S)
        for reader in readers:
            reader.join()
    return lines, memory, errors[-1].strip()[:200] if errors else f"exit {process.returncode}"


def _memory(process: Any) -> tuple[int, int]:
    """Resident bytes of a process and its children, and the share that is theirs."""
    import psutil

    rss = pss = 0
    for each in [process, *process.children(recursive=True)]:
        try:
            full = each.memory_full_info()
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
        rss += full.rss
        pss += getattr(full, "pss", full.uss)
    return rss, pss


if __name__ == "__main__":
    for line in epochs(json.loads(sys.argv[1])):
        print(json.dumps(line), flush=True)
