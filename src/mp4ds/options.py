"""Options, declared once: as fields of dataclasses, with everything the command line shows.

Errors name an option by its field, in backticks; the command line turns it into the flag.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from datetime import datetime, timezone
from typing import Any

from mp4ds.errors import OptionError

_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}


@dataclass(frozen=True, slots=True)
class Shown:
    """How an option is shown.

    Attributes:
        help: A phrase.
        flags: Of the command line; without a long one it is named like the field.
        metavar: Placeholder for its value.
        least: The minimum; None for any value.
        most: The maximum; None for any value.
        parse: Converts text to the value, if the command line cannot do so itself.
        default: The default as text, if there is `parse`.
    """

    help: str
    flags: tuple[str, ...]
    metavar: str | None
    least: float | None
    most: float | None
    parse: Callable[[str], Any] | None
    default: str | None


def option(
    help: str,  # noqa: A002 - as all libraries of command lines call it
    default: Any = None,
    *flags: str,
    metavar: str | None = None,
    least: float | None = None,
    most: float | None = None,
    parse: Callable[[str], Any] | None = None,
    default_text: str | None = None,
) -> Any:
    """A field of `Options`; see `Shown`."""
    shown = Shown(help, flags, metavar, least, most, parse, default_text)
    return field(default=default, metadata={"shown": shown})


def argument(help: str, default: Any) -> Any:  # noqa: A002
    """A field of `Options` that is no option of a command."""
    return field(default=default, metadata={"help": help})


class Options:
    """Base of dataclasses of options: documents their fields, and keeps values within bounds.

    Raises:
        OptionError: A value is out of its bounds.
    """

    def __init_subclass__(cls) -> None:
        told = {
            name: value.metadata.get("help") or value.metadata["shown"].help
            for name, value in vars(cls).items()
            if isinstance(value, Field)
        }
        lines = [f"    {name}: {text}" for name, text in told.items()]
        cls.__doc__ = "\n".join([f"{cls.__doc__}\n\nAttributes:", *lines])

    def __post_init__(self) -> None:
        for name, shown in shown_of(type(self)).items():
            value = getattr(self, name)
            if not isinstance(value, (int, float)) or shown.least is shown.most is None:
                continue
            least, most = shown.least, shown.most
            if (least is not None and not value >= least) or (most is not None and value > most):
                bounds = f"not from {least} to {most}" if most is not None else f"below {least}"
                raise OptionError(f"`{name}` {value} is {bounds}.")


def shown_of(kind: type[Options]) -> Mapping[str, Shown]:
    """What is shown of the options of a dataclass, by field."""
    declared: Any = kind  # a dataclass, which is what makes it one
    return {
        item.name: item.metadata["shown"] for item in fields(declared) if "shown" in item.metadata
    }


# ---------------------------------------------------------------- values of text


def parse_size(text: str) -> int:
    """Bytes of ``8G``, ``500M`` or ``1.5GB``; units of 1024.

    Raises:
        OptionError: It is not a size.
    """
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?) *([kmgt]?)(?:i?b)?", text.strip().lower())
    size = int(float(match[1]) * _UNITS[match[2]]) if match else 0
    if not size:
        raise OptionError(f"{text!r} is not a size. Use a value such as 8G or 500M.")
    return size


def parse_resize(text: str) -> float | tuple[int, int]:
    """A factor, or width and height, of ``0.5`` or ``640x480``.

    Raises:
        OptionError: It is neither.
    """
    match = re.fullmatch(r"([0-9]{1,6})x([0-9]{1,6})", text.strip().lower())
    if match:
        return int(match[1]), int(match[2])
    try:
        return float(text)
    except ValueError:
        raise OptionError(
            f"`resize` {text!r} is not a size. Use a factor such as 0.5, or WxH such as 640x480."
        ) from None


def parse_words(text: str) -> tuple[str, ...]:
    """The words of a comma-separated list."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


# ---------------------------------------------------------------- times

_NS = 10**9
_LATEST = 2**63 - 1
_NUMBER = re.compile(r"\+?([0-9]{1,19})(?:\.([0-9]{0,9}))?")
_ISO = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?Z?")
_SINCE_1970, _IN_NS = 10**8, 10**11  # smaller numbers are seconds from the beginning, or since 1970


def time_of(text: str, start_ns: int, option: str) -> int:
    """Nanoseconds since 1970 of a time as users write it.

    Args:
        text: ``2.5`` or ``+2.5``: seconds from the beginning; from 1e8 on, ``1700000000.5``:
            seconds since 1970, with nanosecond precision; from 1e11 on, ``1700000000123456789``:
            nanoseconds; ``2023-11-14T22:13:20.5``: UTC.
        start_ns: The beginning.
        option: The option's name, for errors.

    Raises:
        OptionError: It is not written in any of these ways.
    """
    clean = text.strip()
    if clean.isascii() and (match := _NUMBER.fullmatch(clean)):
        number = int(match[1])
        is_since_1970 = number >= _SINCE_1970 and not clean.startswith("+")
        time = (0 if is_since_1970 else start_ns) + _nanoseconds(number, match[2])
        if is_since_1970 and number >= _IN_NS and match[2] is None:
            time = number
        if abs(time) <= _LATEST:
            return time
    elif clean.isascii() and (match := _ISO.fullmatch(clean)):
        try:
            moment = datetime.fromisoformat(match[1]).replace(tzinfo=timezone.utc)
        except ValueError as error:
            raise OptionError(f"`{option}` {text!r} is not a valid date: {error}.") from None
        return _nanoseconds(int(moment.timestamp()), match[2])
    raise OptionError(
        f"`{option}` {text!r} is not a valid time. Use seconds from the beginning or since 1970, "
        "nanoseconds since 1970, or a date such as 2023-11-14T22:13:20.5."
    )


def _nanoseconds(seconds: int, fraction: str | None) -> int:
    return seconds * _NS + int((fraction or "0").ljust(9, "0"))


def iso_text(time_ns: int) -> str:
    """A time as an ISO date in UTC, without trailing zeros; as a number if out of range."""
    seconds, rest = divmod(time_ns, _NS)
    try:
        moment = datetime.fromtimestamp(seconds, timezone.utc)
    except (ValueError, OverflowError, OSError):
        return f"{time_ns} ns"
    fraction = f".{rest:09d}".rstrip("0") if rest else ""
    return f"{moment:%Y-%m-%dT%H:%M:%S}{fraction}Z"


def seconds_text(time_ns: int) -> str:
    """Nanoseconds as seconds, with all digits."""
    sign, (whole, part) = "-" if time_ns < 0 else "", divmod(abs(time_ns), _NS)
    return f"{sign}{whole}.{part:09d}"


@dataclass(frozen=True, slots=True)
class Slice:
    """A time slice, as users write it. False if empty.

    Attributes:
        start: The first time included; None for the beginning.
        end: The time before which everything is included; None for no end.
        duration: Seconds from `start`, or before `end`; None if the others define the slice.
        latched: Include the latched messages from before it.
    """

    start: str | float | None = None
    end: str | float | None = None
    duration: str | float | None = None
    latched: bool = False

    def __bool__(self) -> bool:
        return (self.start, self.end, self.duration) != (None, None, None)

    def times(self, first: int, last: int, place: object) -> tuple[int | None, int | None]:
        """The first log time included, and the first one after; None for open.

        Args:
            first: Of the recording, nanoseconds.
            last: Of the recording, nanoseconds.
            place: The recording, for errors.

        Raises:
            OptionError: A time is not valid, or the slice contains nothing.
        """
        start = None if self.start is None else time_of(_written(self.start), first, "start")
        end = None if self.end is None else time_of(_written(self.end), first, "end")
        if self.duration is not None:
            length = _length(_written(self.duration))
            if start is not None and end is not None:
                raise OptionError("Give at most two of `start`, `end` and `duration`.")
            if end is not None:
                start = max(end - length, -_LATEST)
            else:
                end = min((first if start is None else start) + length, _LATEST)
        if start is not None and end is not None and start >= end:
            raise OptionError(
                f"The slice is empty: `start` is {iso_text(start)}, `end` is {iso_text(end)}."
            )
        if (start is not None and start > last) or (end is not None and end <= first):
            raise OptionError(
                f"{place}: nothing was recorded {_span_text(start, end)}. It has messages from "
                f"{iso_text(first)} to {iso_text(last)}, {(last - first) / _NS:.9g} seconds."
            )
        return start, end


def _written(value: str | float) -> str:
    """A time or duration as users write it, without an exponent."""
    text = str(value)
    return f"{value:.9f}" if isinstance(value, float) and "e" in text else text


def _length(text: str) -> int:
    """Nanoseconds of a duration in seconds."""
    match = _NUMBER.fullmatch(text.strip())
    length = _nanoseconds(int(match[1]), match[2]) if match and text.isascii() else 0
    if not 0 < length <= _LATEST:
        raise OptionError(f"`duration` {text!r} is not a number of seconds, such as 2.5.")
    return length


def _span_text(start: int | None, end: int | None) -> str:
    if start is None:
        return f"before {iso_text(end or 0)}"
    if end is None:
        return f"from {iso_text(start)} on"
    return f"from {iso_text(start)} until {iso_text(end)}"


WHOLE = Slice()
"""No slice: the whole recording."""


class SliceOptions(Options):
    """Base of options that have these three fields."""

    start: str | float | None
    end: str | float | None
    duration: str | float | None
    latched = False

    @property
    def slice(self) -> Slice:
        """The slice of the recording; false for all of it."""
        return Slice(self.start, self.end, self.duration, self.latched)


# ---------------------------------------------------------------- options of several kinds


def topics() -> Any:
    """The option for topics to include."""
    return option("Only matching topics; repeatable.", (), "-t", metavar="GLOB")


def exclude(*flags: str) -> Any:
    """The option for topics to leave out."""
    return option("Leave out matching topics.", (), *flags, "-x", metavar="GLOB")


def resize(help: str = "Scale images down, and the calibrations with them.") -> Any:  # noqa: A002
    """The option for resizing images: a factor, or width and height in pixels."""
    return option(help, None, metavar="0.5|WxH", parse=parse_resize)


def every() -> Any:
    """The option for fewer frames, by number."""
    return option("Keep only every Nth frame, starting with the first.", 1, metavar="N", least=1)


def max_rate() -> Any:
    """The option for fewer frames, by time."""
    return option("Maximum frames per second.", None, metavar="HZ")


def jpeg_quality() -> Any:
    """The option for the quality of JPEG files."""
    return option("Quality of JPEG images that are encoded.", 95, least=1, most=100)


def start() -> Any:
    """The option for the first time included."""
    return option(
        "Begin at this time: seconds from the beginning or since 1970, nanoseconds since 1970, "
        "or an ISO date.",
        metavar="TIME",
    )


def end() -> Any:
    """The option for the time before which everything is included."""
    return option("Stop before this time.", metavar="TIME")


def duration() -> Any:
    """The option for the length of a slice."""
    return option("Length of the slice: seconds from `start`, or before `end`.", metavar="SECONDS")


def latched() -> Any:
    """The option for latched messages from before a slice."""
    return option(
        "Begin a slice with the latched messages from before it, such as those of /tf_static.",
        True,
        "--latched/--no-latched",
    )


def cluster() -> Any:
    """The option for what runs the tasks."""
    return option(
        "Dask scheduler at tcp://HOST:PORT, or slurm; default: this machine.",
        None,
        metavar="ADDRESS",
    )


def force(help: str = "Replace an existing output.") -> Any:  # noqa: A002
    """The option to replace existing output."""
    return option(help, False, "-f")
