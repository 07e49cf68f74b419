"""Options, declared once: as fields of dataclasses, with all that the command line shows of them.

Errors name an option by its field, in backticks; the command line makes its flag of that.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from typing import Any

from mp4ds.errors import OptionError

_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}


@dataclass(frozen=True, slots=True)
class Shown:
    """What is shown of an option.

    Attributes:
        help: A phrase.
        flags: Of the command line; without a long one it is named like the field.
        metavar: What stands for its value.
        least: The least value; None for any.
        most: The greatest value; None for any.
        parse: Makes the value of text, where the command line cannot by itself.
        default: What text stands for the default, where there is `parse`.
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


class Options:
    """Base of dataclasses of options: documents their fields, and keeps values within bounds.

    Raises:
        OptionError: A value is out of its bounds.
    """

    def __init_subclass__(cls) -> None:
        lines = [
            f"    {name}: {value.metadata['shown'].help}"
            for name, value in vars(cls).items()
            if isinstance(value, Field) and "shown" in value.metadata
        ]
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
        OptionError: It is no size.
    """
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?) *([kmgt]?)(?:i?b)?", text.strip().lower())
    size = int(float(match[1]) * _UNITS[match[2]]) if match else 0
    if not size:
        raise OptionError(f"`memory` {text!r} is no size. Give one such as 8G or 500M.")
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
            f"`resize` {text!r} is no size. Give a factor such as 0.5, or WxH such as 640x480."
        ) from None


def parse_words(text: str) -> tuple[str, ...]:
    """The words of a list with commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


# ---------------------------------------------------------------- options of several kinds


def topics() -> Any:
    """The option of topics to take."""
    return option("Only topics that match; may be repeated.", (), "-t", metavar="GLOB")


def exclude(*flags: str) -> Any:
    """The option of topics to leave out."""
    return option("Leave out topics that match.", (), *flags, "-x", metavar="GLOB")


def resize(help: str = "Smaller images, calibrations to match.") -> Any:  # noqa: A002
    """The option of another size of images: a factor, or width and height in pixels."""
    return option(help, None, metavar="0.5|WxH", parse=parse_resize)


def every() -> Any:
    """The option of fewer frames, by number."""
    return option("Every Nth frame only, from the first one on.", 1, metavar="N", least=1)


def max_rate() -> Any:
    """The option of fewer frames, by time."""
    return option("So many frames a second at most.", None, metavar="HZ")


def jpeg_quality() -> Any:
    """The option of the quality of JPEG files."""
    return option("Of JPEG files that are made.", 95, least=1, most=100)


def cluster() -> Any:
    """The option of what runs tasks."""
    return option(
        "Dask scheduler, tcp://HOST:PORT, or slurm; this machine by default.",
        None,
        metavar="ADDRESS",
    )


def force(help: str = "Replace an existing output.") -> Any:  # noqa: A002
    """The option of replacing what is there."""
    return option(help, False, "-f")
