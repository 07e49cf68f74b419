"""Options, declared once: as fields of dataclasses, with everything that is to be known of them.

The command line and the documentation are made from these fields. Errors name an option by its
field, in backticks; the command line turns it into the flag.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import Field, dataclass, field
from datetime import datetime, timezone
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from mp4ds.errors import OptionError

_T = TypeVar("_T")
_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}

WHAT, HOW, WHERE, LONG = "What", "How", "Where", "Long jobs"
PANELS = (WHAT, HOW, WHERE, LONG)
"""What options are about, in the order of help."""

CONTENT, ENCODING = "content", "encoding"
"""What of a result an option may change: what it holds, which a copy of a dataset can do, too; or
how that is encoded. Other options say where it is written and by what means."""


@dataclass(frozen=True, slots=True)
class Declared:
    """What is declared of an option.

    Attributes:
        help: A phrase.
        flags: Of the command line; without a long one it is named like the field. None: it is no
            option of the command line.
        panel: One of `PANELS`.
        metavar: Placeholder for its value.
        least: The minimum; None for any value.
        most: The maximum; None for any value.
        choices: Its values; empty for any.
        parse: Makes the value of text; passes on what is a value.
        changes: `CONTENT`, `ENCODING`, or empty.
        only: The formats, layouts or ROS versions that it works with; empty for all.
        alone: The choice that it means without a value; empty where it has to have one.
    """

    help: str
    flags: tuple[str, ...] | None
    panel: str = HOW
    metavar: str | None = None
    least: float | None = None
    most: float | None = None
    choices: Collection[str] = ()
    parse: Callable[[Any], Any] | None = None
    changes: str = ""
    only: tuple[str, ...] = ()
    alone: str = ""


class Parsed(Generic[_T]):
    """Type of a field that may be given in other ways, such as by text, and is parsed."""

    if TYPE_CHECKING:  # the fields are what type checkers take for descriptors, and plain ones

        def __get__(self, instance: object, owner: type) -> _T: ...
        def __set__(self, instance: object, value: _T | str | float | Sequence[str]) -> None: ...


def option(help: str, default: Any = None, *flags: str, **more: Any) -> Any:  # noqa: A002 - as click has it
    """A field of `Options`; `more` are fields of `Declared`."""
    return field(default=default, metadata={"declared": Declared(help, flags, **more)})


def what(help: str, default: Any = None, *flags: str, **more: Any) -> Any:  # noqa: A002
    """An option for what is taken of something."""
    return option(help, default, *flags, panel=WHAT, **more)


def where(help: str, default: Any = None, *flags: str, **more: Any) -> Any:  # noqa: A002
    """An option for where the result goes."""
    return option(help, default, *flags, panel=WHERE, **more)


def argument(help: str, default: Any = None, *, changes: str = "") -> Any:  # noqa: A002
    """A field of `Options` that is no option of the command line."""
    return field(default=default, metadata={"declared": Declared(help, None, changes=changes)})


class Options:
    """Base of dataclasses of options: documents their fields, parses and checks their values.

    Raises:
        OptionError: A value is not valid, or out of its bounds.
    """

    def __init_subclass__(cls) -> None:
        told = {
            name: declared.help for base in cls.__bases__ for name, declared in declared_in(base)
        }
        for name, value in vars(cls).items():
            if isinstance(value, Field):
                told[name] = value.metadata["declared"].help
        lines = [f"    {name}: {text}" for name, text in told.items()]
        cls.__doc__ = "\n".join([f"{cls.__doc__}\n\nAttributes:", *lines])

    def __post_init__(self) -> None:
        for name, declared in declared_in(type(self)):
            value = getattr(self, name)
            if value is None:
                continue
            try:
                if declared.parse:
                    value = declared.parse(value)
                    object.__setattr__(self, name, value)  # dataclasses of options are frozen
                if declared.choices and value not in ("", *declared.choices):
                    known = ", ".join(declared.choices)
                    raise OptionError(f"{value!r} is not known. Use {known}.")
                if isinstance(value, (int, float)):
                    if declared.least is not None and not value >= declared.least:  # no number, too
                        raise OptionError(f"{value} is below {declared.least:g}.")
                    if declared.most is not None and not value <= declared.most:
                        raise OptionError(f"{value} is above {declared.most:g}.")
            except OptionError as error:
                raise OptionError(f"`{name}` {error}") from None

    def check_for(self, kind: str) -> None:
        """Refuse options that do not work with a format, layout or ROS version.

        Raises:
            OptionError: Names one.
        """
        usual = type(self)()
        for name, declared in declared_in(type(self)):
            is_given = getattr(self, name) != getattr(usual, name)
            if is_given and declared.only and kind not in declared.only:
                works = ", ".join(declared.only)
                raise OptionError(f"`{name}` works with {works}, not with {kind}.")

    def changing(self, *what: str) -> dict[str, Any]:
        """The options that change this of a result, by name."""
        return {
            name: getattr(self, name)
            for name, declared in declared_in(type(self))
            if declared.changes in what
        }


def declared_in(kind: type) -> list[tuple[str, Declared]]:
    """Name and declaration of each field of a dataclass of options."""
    known: Mapping[str, Field[Any]] = getattr(kind, "__dataclass_fields__", {})
    return [(name, item.metadata["declared"]) for name, item in known.items()]


# ---------------------------------------------------------------- values of text


def parse_size(text: str | int) -> int:
    """Bytes of ``8G``, ``500M`` or ``1.5GB``; units of 1024.

    Raises:
        OptionError: It is not a size.
    """
    pattern = r"([0-9]+(?:\.[0-9]+)?) *([kmgt]?)(?:i?b)?"
    match = re.fullmatch(pattern, str(text).strip().lower())
    size = int(float(match[1]) * _UNITS[match[2]]) if match else 0
    if not size:
        raise OptionError(f"{text!r} is not a size. Use a value such as 8G or 500M.")
    return size


def parse_resize(value: str | float | tuple[int, int]) -> float | tuple[int, int]:
    """A factor, or width and height, of ``0.5`` or ``640x480``.

    Raises:
        OptionError: It is neither.
    """
    if not isinstance(value, str):
        return value
    match = re.fullmatch(r"([0-9]{1,6})x([0-9]{1,6})", value.strip().lower())
    if match:
        return int(match[1]), int(match[2])
    try:
        return float(value)
    except ValueError:
        raise OptionError(
            f"{value!r} is not a size. Use a factor such as 0.5, or WxH such as 640x480."
        ) from None


def parse_number(value: str | float) -> float:
    """A number; NaN if it is none."""
    try:
        return math.nan if isinstance(value, bool) else float(value)
    except ValueError:
        return math.nan


def _parse_seconds(value: str | float) -> float:
    """Seconds of ``90``, ``90s``, ``5m`` or ``2h``."""
    text = str(value)
    factor = {"s": 1, "m": 60, "h": 3600}.get(text[-1:])
    number = parse_number(text[:-1]) * factor if factor else parse_number(text)
    if not 0 <= number < 1e9:
        raise OptionError(f"{value} is not a number of seconds, 5m or 2h, from 0 to 999999999 s.")
    return number


def parse_pattern(value: str | re.Pattern[str]) -> re.Pattern[str] | None:
    """A regular expression; None for an empty text.

    Raises:
        OptionError: It is not valid.
    """
    try:
        return re.compile(value) if value else None
    except re.error as error:
        raise OptionError(f"{value!r} is not a valid regular expression: {error}.") from None


def parse_words(value: str | Sequence[_T]) -> Sequence[str | _T]:
    """The words of a comma-separated list."""
    if not isinstance(value, str):
        return value
    return tuple(word.strip() for word in value.split(",") if word.strip())


# ---------------------------------------------------------------- times

_NS = 10**9
_LATEST = 2**63 - 1
_NUMBER = re.compile(r"\+?([0-9]{1,19})(?:\.([0-9]{0,9}))?")
_ISO = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?Z?")
_SINCE_1970, _IN_NS = 10**8, 10**11  # smaller numbers are seconds from the beginning, or since 1970


@dataclass(frozen=True, slots=True)
class Time:
    """A time as users give it.

    Attributes:
        ns: Nanoseconds since 1970, or from the beginning.
        from_start: Whether it is from the beginning.
    """

    ns: int
    from_start: bool

    def after(self, start_ns: int) -> int:
        """Nanoseconds since 1970, of a recording that begins then."""
        return min(start_ns + self.ns if self.from_start else self.ns, _LATEST)

    def __str__(self) -> str:
        return f"+{seconds_text(self.ns)}" if self.from_start else str(self.ns)


def parse_time(value: str | float | Time) -> Time:
    """A time as users write it.

    Args:
        value: ``2.5`` or ``+2.5``: seconds from the beginning; from 1e8 on, ``1700000000.5``:
            seconds since 1970, with nanosecond precision; from 1e11 on, ``1700000000123456789``:
            nanoseconds; ``2023-11-14T22:13:20.5``: UTC.

    Raises:
        OptionError: It is not written in any of these ways.
    """
    if isinstance(value, Time):
        return value
    clean = _written(value).strip()
    if clean.isascii() and (match := _NUMBER.fullmatch(clean)):
        number = int(match[1])
        from_start = number < _SINCE_1970 or clean.startswith("+")
        time = _nanoseconds(number, match[2])
        if not from_start and number >= _IN_NS and match[2] is None:
            time = number
        if time <= _LATEST:
            return Time(time, from_start)
    elif clean.isascii() and (match := _ISO.fullmatch(clean)):
        try:
            moment = datetime.fromisoformat(match[1]).replace(tzinfo=timezone.utc)
        except ValueError as error:
            raise OptionError(f"{value!r} is not a valid date: {error}.") from None
        return Time(_nanoseconds(int(moment.timestamp()), match[2]), from_start=False)
    raise OptionError(
        f"{value!r} is not a valid time. Use seconds from the beginning or since 1970, nanoseconds "
        "since 1970, or a date such as 2023-11-14T22:13:20.5."
    )


def parse_duration(value: str | float | Time) -> Time:
    """The time after so many seconds, such as 2.5.

    Raises:
        OptionError: It is no such number.
    """
    if isinstance(value, Time):
        return value
    text = _written(value).strip()
    match = _NUMBER.fullmatch(text)
    length = _nanoseconds(int(match[1]), match[2]) if match and text.isascii() else 0
    if not 0 < length <= _LATEST:
        raise OptionError(f"{value!r} is not a number of seconds, such as 2.5.")
    return Time(length, from_start=True)


def _written(value: str | float) -> str:
    """A time or duration as users write it, without an exponent."""
    text = str(value)
    return f"{value:.9f}" if isinstance(value, float) and "e" in text else text


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


# ---------------------------------------------------------------- topics


class Selection:
    """Topics chosen by globs.

    Args:
        topics: Globs, at least one of which must match; empty for all topics.
        exclude: Globs, none of which may match.
    """

    def __init__(self, topics: Sequence[str] = (), exclude: Sequence[str] = ()) -> None:
        self._topics = tuple(topics)
        self._exclude = tuple(exclude)

    def __call__(self, topic: str) -> bool:
        """Whether the topic is chosen."""
        if self._topics and not _matches(topic, self._topics):
            return False
        return not _matches(topic, self._exclude)

    def check(self, topics: Iterable[str]) -> None:
        """Refuse a pattern that matches nothing: it is a typing error, or data would be missed.

        Raises:
            OptionError: Names the pattern and the topics there are.
        """
        known = sorted(set(topics))
        for option, patterns in (("topics", self._topics), ("exclude", self._exclude)):
            for pattern in patterns:
                if not any(_matches(topic, (pattern,)) for topic in known):
                    listed = ", ".join(known[:20]) + (", ..." if len(known) > 20 else "")
                    raise OptionError(
                        f"`{option}` {pattern!r} matches no topic. Topics: {listed or 'none'}."
                    )


def _matches(topic: str, patterns: Iterable[str]) -> bool:
    return any(
        fnmatchcase(topic, pattern) or fnmatchcase("/" + topic.lstrip("/"), pattern)
        for pattern in patterns
    )


# ---------------------------------------------------------------- options of several commands


@dataclass(frozen=True, kw_only=True)
class TopicOptions(Options):
    """Which topics."""

    topics: Sequence[str] = what(
        "Only matching topics; repeatable.", (), "-t", metavar="GLOB", changes=CONTENT
    )
    exclude: Sequence[str] = what(
        "Leave out matching topics.", (), "-x", metavar="GLOB", changes=CONTENT
    )

    @property
    def selected(self) -> Selection:
        """Which topics, by globs."""
        return Selection(self.topics, self.exclude)


@dataclass(frozen=True, kw_only=True)
class SliceOptions(Options):
    """Which time: a slice of the recording, or all of it."""

    start: Parsed[Time | None] = what(
        "Begin at this time: seconds from the beginning or since 1970, nanoseconds since 1970, "
        "or an ISO date.",
        metavar="TIME",
        parse=parse_time,
        changes=CONTENT,
    )
    end: Parsed[Time | None] = what(
        "Stop before this time.", metavar="TIME", parse=parse_time, changes=CONTENT
    )
    duration: Parsed[Time | None] = what(
        "Length of the slice: seconds from `start`, or before `end`.",
        metavar="SECONDS",
        parse=parse_duration,
        changes=CONTENT,
    )

    latched = False  # for those without the option

    @property
    def is_slice(self) -> bool:
        """Whether they choose less than the whole recording."""
        return (self.start, self.end, self.duration) != (None, None, None)

    def slice_times(self, first: int, last: int, place: object) -> tuple[int | None, int | None]:
        """The first log time included, and the first one after; None for open.

        Args:
            first: Of the recording, nanoseconds.
            last: Of the recording, nanoseconds.
            place: The recording, for errors.

        Raises:
            OptionError: The slice contains nothing.
        """
        start = None if self.start is None else self.start.after(first)
        end = None if self.end is None else self.end.after(first)
        if self.duration is not None:
            if start is not None and end is not None:
                raise OptionError("Give at most two of `start`, `end` and `duration`.")
            if end is not None:
                start = max(end - self.duration.ns, -_LATEST)
            else:
                end = self.duration.after(first if start is None else start)
        if start is not None and end is not None and start >= end:
            raise OptionError(
                f"The slice is empty: `start` is {iso_text(start)}, `end` is {iso_text(end)}."
            )
        if (start is not None and start > last) or (end is not None and end <= first):
            bounds = [f"from {iso_text(start)}"] if start is not None else []
            bounds += [f"until {iso_text(end)}"] if end is not None else []
            raise OptionError(
                f"{place}: nothing was recorded {' '.join(bounds)}. It has messages from "
                f"{iso_text(first)} to {iso_text(last)}, {(last - first) / _NS:.9g} seconds."
            )
        return start, end


def latched() -> Any:
    """The option for latched messages from before a slice."""
    return what(
        "Begin a slice with the latched messages from before it, such as those of /tf_static.",
        True,
        "--latched/--no-latched",
        changes=CONTENT,
    )


def jpeg_quality() -> Any:
    """The option for the quality of JPEG files."""
    return option("Quality of JPEG images that are encoded.", 95, least=1, most=100)


def pattern(help: str, *flags: str) -> Any:  # noqa: A002
    """An option for topics by a regular expression."""
    return what(help, None, *flags, metavar="PATTERN", parse=parse_pattern)


def seconds(help: str, default: float | None = None, *flags: str, panel: str = HOW) -> Any:  # noqa: A002
    """An option for a number of seconds, which may be 0."""
    return option(help, default, *flags, panel=panel, metavar="SECONDS", parse=_parse_seconds)


def about() -> Any:
    """The option for the description of a dataset."""
    return option(
        "YAML file with title, description, authors, license, doi, links or keywords.",
        metavar="FILE",
        changes=CONTENT,
    )


def jobs(help: str, default: int | None = None) -> Any:  # noqa: A002
    """The option for the number of processes."""
    return option(help, default, "-j", panel=LONG, metavar="N", least=1, most=1024)


def force(help: str = "Replace an existing output.") -> Any:  # noqa: A002
    """The option to replace existing output."""
    return where(help, False, "-f")
