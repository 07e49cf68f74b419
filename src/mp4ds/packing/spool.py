"""The folder of a recording that is being made, or was when the recorder stopped.

What arrives is in a spool: MCAP files ``000000.mcap``, ``000001.mcap`` and so on, its pieces. Each
is packed into a part ``000000``, an ordinary dataset, and then removed. ``recording.json`` says
how, and is locked by the recorder. In the end, the parts are joined.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from itertools import pairwise
from pathlib import Path
from typing import IO, Literal

from mp4ds.bags.mcap import McapWriter, copy_verified
from mp4ds.bags.protocols import Format
from mp4ds.bags.salvage_mcap import McapSalvage
from mp4ds.dataset.checks import validate
from mp4ds.dataset.concat import concat
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import FormatError, Refused, SourceError
from mp4ds.files.outputs import check_target, is_mine, lock, staged, work_folder
from mp4ds.files.sources import RECORDING_NAME
from mp4ds.format.fields import Gop, Model, Profile
from mp4ds.format.manifest import About, LossEntry, Source
from mp4ds.packing.manifest import PartRecord, dataset_files, summarize
from mp4ds.packing.options import PackOptions, PackSummary
from mp4ds.records import Loss, Message, MetadataRecord, Record, bounded
from mp4ds.video.codecs import SPEED

_NAME = re.compile(r"([0-9]{6})(\.mcap)?")
_ONE_PASS = 10_000_000  # frames of a window: a piece is not divided again
_MOST_BYTES = 2**16


class SpoolSettings(Model):
    """How the pieces of a spool are packed: all of them alike, so that parts fit together."""

    format: Format
    profile: Literal["ros1", "ros2"]
    quality: Profile
    codec: str | None
    preset: str | None
    gop: Gop | None
    looks_back: bool = False
    """Only the newest pieces are there, and in piece 0 the latched messages from before them."""

    def options(self, *, salvage: bool = False) -> PackOptions:
        """The options of a pack."""
        return PackOptions(
            quality=self.quality,
            codec=self.codec,
            preset=self.preset,
            gop=self.gop,
            purpose=SPEED,
            window=_ONE_PASS,
            salvage=salvage,
        )


PackPiece = Callable[[Path, Path, PackOptions], object]
"""Packs a recording into a dataset; see `mp4ds.pack`."""


class SpoolFolder:
    """The folder, its pieces and parts.

    Args:
        path: The folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._settings_path = path / RECORDING_NAME

    def begin(self, settings: SpoolSettings) -> IO[bytes]:
        """Make the folder, which must not exist; it is not synced yet.

        Returns:
            What locks it: nobody takes it for one that was left while this is open. The lock is
            shared with the process that packs, which may outlive a recorder that is killed.

        Raises:
            FileExistsError: It exists.
            OSError: It cannot be written.
        """
        self.path.mkdir()
        file = self._settings_path.open("xb")
        lock(file, shared=True)
        file.write(settings.model_dump_json(indent=1).encode() + b"\n")
        file.flush()
        return file

    def locked(self, *, shared: bool = False) -> IO[bytes]:
        """Lock it while what is returned is open.

        Args:
            shared: For a part of its recorder; else only where no recorder is at work.

        Raises:
            SourceError: It is being recorded; shared: it is being recovered.
        """
        file = self._settings_path.open("r+b")
        try:
            lock(file, shared=shared)
        except BlockingIOError:
            file.close()
            if shared:
                raise SourceError(self.path, "is being recovered", "Wait for its end.") from None
            remedy = "Wait, or stop the recorder."
            raise SourceError(self.path, "is being recorded", remedy) from None
        return file

    def settings(self) -> SpoolSettings:
        """How its pieces are packed.

        Raises:
            SourceError: It does not say so.
        """
        try:
            with self._settings_path.open("rb") as file:
                return SpoolSettings.model_validate_json(file.read(_MOST_BYTES))
        except ValueError:
            raise SourceError(
                self._settings_path,
                "is damaged, or of another version of mp4ds",
                "Use the version that made the recording.",
            ) from None

    def piece(self, number: int) -> Path:
        """Where a piece is, as long as it is not packed."""
        return self.path / f"{number:06}.mcap"

    def part(self, number: int) -> Path:
        """Where the part of a piece is."""
        return self.path / f"{number:06}"

    def join(
        self,
        parts: Sequence[Path],
        target: Path,
        *,
        force: bool,
        about: About | None,
        sources: Sequence[Source] = (),
        losses: Sequence[Loss] = (),
        is_foreign: bool = False,
    ) -> PackSummary:
        """Make the dataset of all parts, perhaps from somebody else; the spool is no source of it.

        Args:
            parts: The parts, in order.
            target: The dataset.
            force: Replace an existing dataset.
            about: Description of the recording.
            sources: What it is a slice of, if any.
            losses: What could not be read of pieces.
            is_foreign: Whether parts may be from somebody else.

        Raises:
            Mp4dsError: It could not be made; the parts are still there.
        """
        with (
            staged(target, force=force, owned=dataset_files, sources=parts) as made,
            ExitStack() as stack,
        ):
            made.mkdir()
            datasets = [stack.enter_context(Dataset(part)) for part in parts]
            manifests = [one.manifest for one in datasets if one.manifest]
            known = [entry.to_record() for one in manifests for entry in one.losses]
            lost = bounded([*losses, *known])
            changes = {
                "about": about,
                "format": self.settings().format,
                "library": "",
                "sources": list(sources),
                "losses": list(map(LossEntry.from_record, lost)),
            }
            try:
                concat(datasets, made, changes=changes)
            except Refused as reason:
                raise SourceError(self.path, f"cannot be joined: {reason}") from None
            for problem in validate(made) if is_foreign else ():
                raise FormatError(problem.code, self.path, str(problem))
            return summarize(PartRecord(made, losses=list(lost)), target, 0, is_copy=True)

    def remove(self, count: int) -> None:
        """Remove the folder with all parts; files that somebody else put there stay."""
        for number in range(count):
            remove_dataset(self.part(number))
        self._settings_path.unlink()
        _remove_empty(self.path)


def remove_dataset(path: Path) -> None:
    """Remove a dataset; files that somebody else put there stay."""
    for name in dataset_files(path) or ():
        (path / name).unlink(missing_ok=True)
    _remove_empty(path)


def _remove_empty(folder: Path) -> None:
    if not any(folder.iterdir()):
        folder.rmdir()


# ---------------------------------------------------------------- recovery


def recover(
    path: Path, target: Path, pack: PackPiece, *, force: bool, about: About | None
) -> PackSummary:
    """Make the dataset of a recording that was cut off: pack what is left, and join all.

    The folder may come from anybody: names and values are checked, and what belongs to another
    user is not read.

    Args:
        path: Where the recording was made; it stays as it is.
        target: The dataset.
        pack: Packs a piece.
        force: Replace an existing dataset.
        about: Description of the recording.

    Raises:
        SourceError: It is being recorded, is damaged, or belongs to another user.
        TargetError: The dataset may not be written there.
        WriteError: The disk refused.
    """
    check_target(target, force=force, owned=dataset_files, sources=[path])
    _check_owner(path, path.absolute().parent)
    folder = SpoolFolder(path)
    found = _found(path)
    if not found:
        raise SourceError(path, "holds no messages")
    with folder.locked(), work_folder(target.parent, f".{target.name}.") as place:
        settings = folder.settings()
        oldest = min({*found} - {0}, default=0)
        old = range(1, oldest or 1) if settings.looks_back else ()
        parts, losses = [], _gaps([*sorted({*found, *old})])
        for number, is_packed in found.items():
            piece, part = folder.piece(number), folder.part(number)
            if not is_packed:
                part, copy = place / part.name, place / piece.name
                losses += copy_verified(piece, copy)
                if settings.looks_back and oldest and number == 0:
                    _leave_out_repeated(copy, folder.piece(oldest), settings.profile)
                try:
                    pack(copy, part, settings.options(salvage=True))
                except SourceError as error:  # not a record of it is left
                    losses.append(Loss(piece.name, 0, piece.stat().st_size, error.problem))
                    continue
                finally:
                    copy.unlink()
            parts.append(part)
        if not parts:
            raise SourceError(path, "holds no messages that can be read")
        try:
            return folder.join(
                parts, target, force=force, about=about, losses=losses, is_foreign=True
            )
        except FormatError as error:
            remedy = "Move that part out of the folder to recover the others."
            problem = f"has a damaged part: {str(error).removesuffix('.')}"
            raise SourceError(path, problem, remedy) from None


def _leave_out_repeated(path: Path, oldest: Path, profile: str) -> None:
    """Write the latched messages again, without those of a piece that was about to be removed."""
    known = {_key(record) for record in _records(path)}
    if repeated := known.intersection(map(_key, _records(oldest))) - {None}:
        whole = path.rename(path.with_suffix(".whole"))
        writer = McapWriter(path, profile=profile, compression="none")
        for record in _records(whole):
            if isinstance(record, MetadataRecord):
                writer.add_metadata(record)
            elif isinstance(record, Message) and _key(record) not in repeated:
                writer.add_channel(record.channel)
                writer.write(record)
        writer.finish()


def _records(piece: Path) -> Iterator[Record]:
    with suppress(SourceError), McapSalvage(piece) as reader:
        yield from reader.records()


def _key(record: Record) -> tuple[object, ...] | None:
    if isinstance(record, Message):
        return record.channel.identity, record.log_time, bytes(record.data)
    return None


def _gaps(found: Sequence[int]) -> list[Loss]:
    """What is missing between pieces that are there, which no recorder leaves."""
    losses = []
    for before, after in pairwise([-1, *found]):
        if after > before + 1:
            missing = "this piece of the recording is missing"
            if after > before + 2:
                missing = f"pieces {before + 1} to {after - 1} of the recording are missing"
            losses.append(Loss(f"{before + 1:06}.mcap", None, None, missing))
    return losses


def _found(path: Path) -> dict[int, bool]:
    """The numbers of pieces and parts in a folder, and whether a piece is packed.

    Raises:
        SourceError: One of them, or a file of a part, is not an ordinary one of this user.
    """
    found: dict[int, bool] = {}
    _check(path / RECORDING_NAME)
    for entry in sorted(path.iterdir()):
        if match := _NAME.fullmatch(entry.name):
            number, is_part = int(match[1]), not match[2]
            _check(entry, is_folder=is_part)
            for inner in entry.iterdir() if is_part else ():
                _check(inner)
            found[number] = found.get(number, False) or is_part
    return found


def _check(path: Path, *, is_folder: bool = False) -> None:
    """Refuse what a recorder of this user has not made.

    Raises:
        SourceError: Says why.
    """
    found = path.lstat()
    if not (stat.S_ISDIR if is_folder else stat.S_ISREG)(found.st_mode):
        kind = "folder" if is_folder else "file"
        problem = "is a symbolic link" if path.is_symlink() else f"is not a regular {kind}"
        raise SourceError(path, problem, f"Put the recorder's own {kind} in its place.")
    _check_owner(path, path.parent)


def _check_owner(path: Path, beside: Path) -> None:
    """Refuse what belongs to another user.

    Raises:
        SourceError: It does.
    """
    if not is_mine(path.lstat(), beside):
        remedy = "If you trust it, salvage a copy of the folder that you own."
        raise SourceError(path, "belongs to another user", remedy)
