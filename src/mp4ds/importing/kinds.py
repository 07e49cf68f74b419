"""Which images of one folder are of which camera, where nothing but a rate tells their times."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from mp4ds.errors import SourceError
from mp4ds.video.image_files import image_kind

_MOST = 8  # cameras; more words are no names of cameras
_LOOKED_AT = 8
# a number, but for that of a camera such as cam0
_NUMBER = re.compile(r"(?<!\d)(?<!cam)(?<!camera)\d+|(?<=cam)\d{2,}|(?<=camera)\d{2,}", re.I)
_HEX = re.compile(r"[0-9a-f]+", re.I)
_WORD = re.compile(r"[^\W_]+")
_ADVICE = (
    "One rate does not tell their times. Give --stamps FILE with a time and a file name in each "
    "line, or put those of each camera into a folder of its own."
)


def by_camera(folder: Path, images: Sequence[Path]) -> Mapping[str, list[Path]]:
    """The images of each camera by its name, which is empty where there is one camera.

    There are several where the names have different words or endings and the same numbers:
    ``color_0001.jpg`` and ``depth_0001.png``.

    Args:
        folder: For errors.
        images: In order.

    Raises:
        SourceError: Nothing tells whether they are of one camera.
    """
    kinds: dict[str, list[Path]] = {}
    for path in images:
        kinds.setdefault(_NUMBER.sub("#", path.stem) + path.suffix.lower(), []).append(path)
    numbers = [[_numbers(path) for path in paths] for paths in kinds.values()]
    cameras = {"": list(images)}
    if _may_be_cameras(images, numbers):
        if any(found != numbers[0] for found in numbers):
            first, second = (paths[0].name for paths in list(kinds.values())[:2])
            raise SourceError(
                folder,
                f"holds images of several kinds by their names, such as {first} and {second}, and "
                "not the same numbers of each",
                _ADVICE,
            )
        cameras = dict(zip(_names(list(kinds)), kinds.values(), strict=True))
    for paths in cameras.values():
        _check_turns(folder, paths)
    return cameras


def _numbers(path: Path) -> tuple[int, ...]:
    return tuple(map(int, _NUMBER.findall(path.stem)))


def _may_be_cameras(images: Sequence[Path], numbers: Sequence[list[tuple[int, ...]]]) -> bool:
    """Whether there are a few kinds, and one number is in several of them."""
    if not 1 < len(numbers) <= _MOST or min(map(len, numbers)) < 2:
        return False
    endings = {path.suffix.lower() for path in images}
    if len(endings) < len(numbers) and all(_HEX.fullmatch(path.stem) for path in images):
        return False  # letters are digits, too
    return len(set().union(*numbers)) < len(images)


def _names(kinds: Sequence[str]) -> list[str]:
    """A name for each camera: the words that not all have; else the ending of its files."""
    words = [_WORD.findall(Path(kind).stem) for kind in kinds]
    shared = set(words[0]).intersection(*words)
    names = ["_".join(word for word in own if word not in shared) for own in words]
    if len(set(names)) < len(names):
        endings = [Path(kind).suffix[1:] for kind in kinds]
        names = ["_".join(filter(None, pair)) for pair in zip(names, endings, strict=True)]
    if len(set(names)) < len(names):
        return [f"camera{number}" for number in range(len(names))]
    return [name or "camera" for name in names]


def _check_turns(folder: Path, images: Sequence[Path]) -> None:
    """Refuse images of two cameras in turns; a camera may well change its size."""
    kinds = [_kind(path) for path in images[:_LOOKED_AT]]
    changes = [place for place in range(1, len(kinds)) if kinds[place] != kinds[place - 1]]
    if len(changes) >= len(set(kinds)) > 1:
        first, second = (
            f"{images[place].name} ({kinds[place]})" for place in (changes[0] - 1, changes[0])
        )
        raise SourceError(
            folder, f"holds images of several kinds in turns, such as {first} and {second}", _ADVICE
        )


def _kind(path: Path) -> str:
    try:
        return image_kind(path)
    except SourceError:  # JPEG files are kept whatever is in them
        return path.suffix.lower()
