"""Folders of images with times, and videos, as recordings; calibrations in the YAML of ROS."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, Field, FiniteFloat, ValidationError

from mp4ds import yamlio
from mp4ds.errors import FormatError, OptionError, Refused, SourceError, SourceNotFoundError
from mp4ds.files.sources import members
from mp4ds.files.urls import remote
from mp4ds.format.models import EXACT_SUFFIX
from mp4ds.format.sidecars import MANIFEST_NAME, model_problems
from mp4ds.messages.wire import CalibrationFields
from mp4ds.packing.options import ImportOptions, plugin
from mp4ds.plugins.importing.reader import ImagesReader, reading
from mp4ds.video.decoder import Clip, open_video
from mp4ds.video.images import STILL_SUFFIXES, image_size

MAX_STAMP = 2**31 * 10**9 - 1
"""The latest time that a ROS 2 message can represent, nanoseconds: in 2038."""

_LEROBOT = "meta/info.json"


def open_images(folder: Path, options: ImportOptions) -> ImagesReader:
    """Open a folder of images, or a video, as a recording.

    Args:
        folder: The folder or video, on this machine.
        options: How to read it.

    Raises:
        SourceError: It cannot be read; says why and what to do.
        OptionError: The options do not apply to it.
    """
    if remote(folder):
        raise SourceError(folder, "cannot be read remotely", "Download it first.")
    if not folder.exists():
        raise SourceNotFoundError(folder)
    if options.topic is not None and not options.topic.strip("/"):
        raise OptionError(f"`topic` {options.topic!r} is not a topic name.")
    with reading(folder):
        if options.episode is not None or (folder / _LEROBOT).is_file():
            reader: ImagesReader = plugin("importing.lerobot:open_episode")(folder, options)
            return reader
        reader = ImagesReader(folder)
        if folder.is_file():
            options.check_for("video")
            _add_video(reader, options)
        else:
            options.check_for("plain")
            _add_plain(reader, options)
    if options.calibration:
        reader.add_file(Path(options.calibration), is_kept=True)
    return reader


def episodes_in(folder: Path) -> list[int]:
    """The numbers of the episodes of a LeRobotDataset v3.

    Raises:
        SourceError: It is not one, or has none.
        OptionError: The library for its tables is missing.
    """
    if not (folder / _LEROBOT).is_file():
        raise SourceError(folder, f"is not a LeRobotDataset v3: it has no {_LEROBOT}")
    with reading(folder):
        found: list[int] = plugin("importing.lerobot:episodes_in")(folder)
    return found


def _named(options: ImportOptions) -> tuple[str, str]:
    """Topic and frame id of the only camera."""
    frame_id = options.frame_id if options.frame_id is not None else "camera"
    return options.topic or "/camera/image_raw", frame_id


# ---------------------------------------------------------------- video


def _add_video(reader: ImagesReader, options: ImportOptions) -> None:
    """Add the frames of a video.

    Raises:
        SourceError: They cannot be messages, or there are not as many times.
    """
    is_half = reader.path.name.endswith(EXACT_SUFFIX)
    if is_half or (reader.path.parent / MANIFEST_NAME).is_file():
        raise SourceError(
            reader.path,
            "is a video of a dataset, which also has its stamps and what makes it exact",
            "Use the dataset itself: `mp4ds pack`, `unpack` and the others take it.",
        )
    clip = Clip(open_video(reader.path), pictures="rgb24" if options.decode else "")
    reader.add_file(reader.path)
    stamps, source = clip.file.times, reader.path
    if options.stamps:
        source = Path(options.stamps)
        lines, stamps, _ = _read_list(reader, source, options.unit)
        if len(stamps) != len(clip.numbers):
            raise SourceError(
                source, f"has {len(stamps)} times, but {reader.path} has {len(clip.numbers)} frames"
            )
        if (back := np.flatnonzero(np.diff(stamps) < 0)).size:
            problem = f"line {lines[back[0] + 1]}: it is earlier than the time before"
            raise SourceError(source, problem)
    elif options.unit:
        raise OptionError("`unit` is that of `stamps`. Give a list of times, too.")
    offset = options.offset.ns if options.offset else 0
    if stamps[0] + offset < 0 or int(stamps[-1]) + offset > MAX_STAMP:
        problem = "has times before 1970 or after 2038, the range of ROS 2 times"
        raise SourceError(source, problem, "Give `offset`.")
    topic, frame_id = _named(options)
    calibration = _calibration(options, topic, clip.file.size)
    reader.add_clip(topic, frame_id, clip, stamps + offset, calibration=calibration)


# ---------------------------------------------------------------- images

_LISTED = 3
_MOST = 8  # cameras; more words are not names of cameras
# a number, except for that of a camera such as cam0
_NUMBER = re.compile(r"(?<!\d)(?<!cam)(?<!camera)\d+|(?<=cam)\d{2,}|(?<=camera)\d{2,}", re.I)
_HEX = re.compile(r"[0-9a-f]+", re.I)


def _images_in(folder: Path) -> list[Path]:
    """The images directly in a folder, in the order of the numbers in their names."""
    found = [path for path in members(folder) if path.suffix.lower() in STILL_SUFFIXES]
    return sorted(found, key=_in_order)


def _in_order(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Sorts 9 before 10, with or without leading zeros."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(int(part or 0), "") if n % 2 else (0, part) for n, part in enumerate(parts)], path.name


def _add_plain(reader: ImagesReader, options: ImportOptions) -> None:
    """Add the images of one camera.

    Raises:
        SourceError: There are none, or their times are unknown.
        OptionError: An option is wrong.
    """
    if options.stamps and options.rate:
        raise OptionError(
            "`stamps` gives the times that `rate` would make up. Give only one of them."
        )
    folder = reader.path
    images = files = _images_in(folder)
    if not images:
        raise SourceError(folder, *_elsewhere(folder))
    if options.rate:
        _check_one_camera(folder, images)
        stamps = _at_rate(len(images), options.rate)
    elif options.stamps:
        path = Path(options.stamps)
        lines, stamps, names = _read_list(reader, path, options.unit)
        if names:
            files = [_image_of(path, folder, *row) for row in zip(lines, names, strict=True)]
        elif len(stamps) != len(images):
            raise SourceError(
                path, f"has {len(stamps)} times, but there are {len(images)} images in {folder}"
            )
    else:
        stamps = _by_name(reader, images, options.unit)
    topic, frame_id = _named(options)
    size = image_size(files[0]) if options.calibration else (0, 0)
    calibration = _calibration(options, topic, size)
    reader.add_camera(topic, frame_id, files, stamps, calibration, options.encoding)
    if unused := len(images) - len(set(files)):
        reader.left_out["images without a time"] = unused
    read = {Path(path).resolve() for path in (options.stamps, options.calibration) if path}
    others = [path for path in members(folder) if path.resolve() not in read]
    others = [path for path in others if path.suffix.lower() not in STILL_SUFFIXES]
    if others:
        reader.left_out[f"files in {folder.resolve().name} that are not images"] = len(others)
    reader.add_file(folder)


def _check_one_camera(folder: Path, images: Sequence[Path]) -> None:
    """Refuse images of several cameras: names with different words, and the same numbers.

    Raises:
        SourceError: They are ``color_0001.jpg`` and ``depth_0001.png``, or the like.
    """
    kinds: dict[str, list[Path]] = {}
    for path in images:
        kinds.setdefault(_NUMBER.sub("#", path.stem) + path.suffix.lower(), []).append(path)
    if not 1 < len(kinds) <= _MOST or min(map(len, kinds.values())) < 2:
        return
    endings = {path.suffix.lower() for path in images}
    if len(endings) < len(kinds) and all(_HEX.fullmatch(path.stem) for path in images):
        return  # hexadecimal letters are digits, too
    if len({tuple(map(int, _NUMBER.findall(path.stem))) for path in images}) < len(images):
        first, second = (paths[0].name for paths in list(kinds.values())[:2])
        raise SourceError(
            folder,
            f"holds images of several cameras, judging by names such as {first} and {second}",
            "Put each camera's images into a folder of its own.",
        )


def _elsewhere(folder: Path) -> tuple[str, str]:
    """That a folder holds no images itself, where some are, and what to do."""
    below = sorted((*folder.glob("*/*"), *folder.glob("mav0/*/data/*")))  # as EuRoC has them
    images = (path for path in below if path.suffix.lower() in STILL_SUFFIXES)
    places = [*dict.fromkeys(str(path.parent.relative_to(folder)) for path in images)]
    if not places:
        return "holds no images", ""
    listed = ", ".join([*places[:_LISTED], *["..."] * (len(places) > _LISTED)])
    return f"holds no images itself; there are some in {listed}", "Import each camera alone."


# ---------------------------------------------------------------- times

_UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_CERTAIN_DIGITS = 16  # of nanoseconds since 1970; counts of seconds or images have fewer
_TIME = re.compile(r"\+?([0-9]{1,40})(?:(\.[0-9]{0,40})?([eE][-+]?[0-9]{1,2})?)?")
_IN_NS = re.compile(r"(?<![A-Za-z])ns\b")
_MAX_TEXT = 2**30
_MAX_LINE = 2**16


def _is_time(text: str) -> bool:
    """Whether a text is a number that may be a time."""
    return _TIME.fullmatch(text) is not None


def _unit_of(texts: Sequence[str]) -> str | None:
    """The unit of numbers: seconds if one has decimals, nanoseconds if they are long, or None."""
    if any(not text.lstrip("+").isdigit() for text in texts):
        return "s"
    longest = max((len(text.lstrip("+0")) for text in texts), default=0)
    return "ns" if longest >= _CERTAIN_DIGITS else None


def _nanoseconds(reader: ImagesReader, text: str, unit: str) -> int:
    """Nanoseconds of a time, which is rounded and counted if it is finer.

    Raises:
        Refused: It is none.
    """
    if not _is_time(text):
        raise Refused(f"{text!r} is not a time in {unit}")
    exact = Fraction(text) * _UNITS[unit]
    nanoseconds = round(exact)
    if not 0 <= nanoseconds <= MAX_STAMP:
        raise Refused(f"{text!r} is not between 1970 and 2038, the range of ROS 2 times")
    if nanoseconds != exact:
        reader.left_out["times finer than a nanosecond, which were rounded"] += 1
    return nanoseconds


def _at_rate(count: int, rate: str) -> NDArray[np.int64]:
    """Times of images at a rate such as ``20`` or ``30000/1001``, from 0 on, in nanoseconds."""
    try:
        found = Fraction(rate)
    except (ValueError, ZeroDivisionError):
        found = Fraction(0)
    if not Fraction(1, 10**6) <= found <= 10**6:
        raise OptionError(f"`rate`: {rate!r} is not a rate in Hz")
    times = [round(number * 10**9 / found) for number in range(count)]
    if times[-1] > MAX_STAMP:
        raise OptionError(f"`rate`: {rate!r} Hz is too slow for {count} images")
    return np.array(times, np.int64)


def _by_name(reader: ImagesReader, images: list[Path], unit: str | None) -> NDArray[np.int64]:
    """Times that are the names of images."""
    wrong = next((path for path in images if not _is_time(path.stem)), None)
    if wrong is not None and unit is not None:
        raise SourceError(
            wrong, "has a name that is not a time", "Give `stamps` FILE or `rate` HZ."
        )
    unit = unit or _unit_of([path.stem for path in images])
    if wrong is not None or unit is None:
        raise SourceError(
            reader.path,
            "holds images whose names are not times in nanoseconds or decimal seconds",
            "Give `stamps` FILE, `rate` HZ, or the `unit` of the names.",
        )
    stamps = np.empty(len(images), np.int64)
    for place, path in enumerate(images):
        try:
            stamps[place] = _nanoseconds(reader, path.stem, unit)
        except Refused as error:
            raise SourceError(path, f"has a name that is not a time: {error}") from None
    return stamps


def _read_list(
    reader: ImagesReader, path: Path, unit: str | None
) -> tuple[list[int], NDArray[np.int64], list[str]]:
    """A list of times.

    Returns:
        Numbers of its lines, their times in nanoseconds, and their names of images; no names if
        it has none.

    Raises:
        SourceError: A line is not valid; names it.
        OptionError: The unit of the times is unknown.
    """
    rows = _rows_of(path)
    head: list[str] = []
    number, first = next(rows, (0, head))
    if not any(map(_is_time, first)):
        head = first
        number, first = next(rows, (0, []))
    if not first:
        raise SourceError(path, "holds no times")
    time = next((place for place, value in enumerate(first) if _is_time(value)), None)
    if time is None:
        raise SourceError(path, f"line {number} has no time")
    named = (place for place, value in enumerate(first) if value.lower().endswith(STILL_SUFFIXES))
    name = next(named, None)
    if path.parent.resolve() != reader.path.resolve():
        reader.add_file(path)
    lines, texts, names = list[int](), list[str](), list[str]()
    for line, values in chain([(number, first)], rows):
        if len(values) <= max(time, name or 0):
            raise SourceError(path, f"line {line} has {len(values)} values, fewer than before")
        lines.append(line)
        texts.append(values[time])
        names += [] if name is None else [values[name]]
    if unit is None and len(head) > time and _IN_NS.search(head[time]):
        unit = "ns"
    unit = unit or _unit_of(list(filter(_is_time, texts)))
    if unit is None:
        raise OptionError(f"{path}: its times are integers of an unknown unit. Give `unit`.")
    stamps = np.empty(len(lines), np.int64)
    for place, text in enumerate(texts):
        try:
            stamps[place] = _nanoseconds(reader, text, unit)
        except Refused as error:
            raise SourceError(path, f"line {lines[place]}: {error}") from None
    return lines, stamps, names


def _rows_of(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The lines of a list that are neither blank nor comments: their numbers from 1, and values.

    Values are between commas if there is one in the line, else between spaces.
    """
    if path.stat().st_size > _MAX_TEXT:
        raise SourceError(path, f"is larger than {_MAX_TEXT} bytes, so it cannot be a list")
    try:
        with path.open(encoding="utf-8-sig") as stream:
            for number, line in enumerate(iter(lambda: stream.readline(_MAX_LINE + 1), ""), 1):
                if len(line) > _MAX_LINE:  # what follows of it would be taken for another line
                    raise SourceError(path, f"line {number} is too long for a list")
                text = line.strip()
                if text and not text.startswith("#"):
                    parts = text.split(",") if "," in text else text.split()
                    yield number, [part.strip() for part in parts]
    except UnicodeDecodeError:
        raise SourceError(path, "is not a text file") from None


def _image_of(path: Path, folder: Path, number: int, text: str) -> Path:
    """The file that a line of a list names."""
    name = PurePosixPath(text)
    if name.is_absolute() or ".." in name.parts:
        raise SourceError(path, f"line {number} names a file outside of {folder}: {name}")
    image = folder / name
    if not image.is_file():
        raise SourceError(path, f"line {number} names {image}, which does not exist")
    return image


# ---------------------------------------------------------------- calibrations

_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_MAX_YAML = 2**20
# distortion model -> how many parameters it may have
_MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}


def _listed(value: Any) -> Any:
    """The numbers of a list, or of a matrix as OpenCV and ROS write it."""
    found = value.get("data") if isinstance(value, dict) else value
    if not isinstance(found, list) or any(isinstance(item, bool) for item in found):
        raise ValueError("it is not a list of numbers")
    return found


def _whole(value: Any) -> Any:
    """A number that may be written as a float, which may be a string as below."""
    if isinstance(value, bool):
        raise ValueError("it is not a number")
    return float(value) if isinstance(value, str) else value


# YAML 1.1 has floats such as 1., which are strings in the subset: pydantic reads these, too
_Numbers = Annotated[tuple[FiniteFloat, ...], BeforeValidator(_listed)]
_Nine = Annotated[_Numbers, Field(min_length=9, max_length=9)]
_Twelve = Annotated[_Numbers, Field(min_length=12, max_length=12)]
_Side = Annotated[int, BeforeValidator(_whole), Field(gt=0, lt=2**31)]


class _Calibration(BaseModel):
    """What ROS's camera_calibration saves."""

    image_width: _Side
    image_height: _Side
    camera_matrix: _Nine
    distortion_model: str
    distortion_coefficients: _Numbers
    rectification_matrix: _Nine = _IDENTITY
    projection_matrix: _Twelve = ()


def _calibration(
    options: ImportOptions, topic: str, size: tuple[int, int]
) -> CalibrationFields | None:
    """The given calibration, for the images of a camera.

    Raises:
        SourceError: It is not valid, or made for a different image size.
    """
    if not options.calibration:
        return None
    path = Path(options.calibration)
    try:
        if path.stat().st_size > _MAX_YAML:
            raise SourceError(
                path, f"is larger than {_MAX_YAML} bytes, so it cannot be a calibration"
            )
        saved = _Calibration.model_validate(yamlio.load(path.read_bytes(), str(path)))
    except FormatError as error:
        raise SourceError(path, error.problem) from None
    except ValidationError as error:
        raise _invalid(path, ": ".join(model_problems(error)[0])) from None
    found = saved.image_width, saved.image_height
    if found != size:
        problem = f"is for images of {found[0]}x{found[1]}, but those of {topic} are "
        raise SourceError(path, f"{problem}{size[0]}x{size[1]}")
    model, d, k = saved.distortion_model, saved.distortion_coefficients, saved.camera_matrix
    if model not in _MODELS:
        known = ", ".join(_MODELS)
        raise _invalid(path, f"distortion_model {model!r} is not known; known are {known}")
    if len(d) not in _MODELS[model]:
        listed = " or ".join(map(str, _MODELS[model]))
        raise _invalid(path, f"{model} has {listed} distortion_coefficients, not {len(d)}")
    if model == "plumb_bob":  # ROS's also has the third radial coefficient
        d = (*d, 0.0)[:5]
    p = saved.projection_matrix or (*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0)
    return CalibrationFields(found[1], found[0], model, d, k, saved.rectification_matrix, p)


def _invalid(path: Path, reason: str) -> SourceError:
    remedy = "Give a YAML file saved by ROS's camera_calibration."
    return SourceError(path, f"is not a valid calibration: {reason}", remedy)
