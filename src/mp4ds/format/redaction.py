"""The file of rules of what to redact in images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from mp4ds import yamlio
from mp4ds.errors import OptionError
from mp4ds.format.sidecars import model_problems
from mp4ds.options import Time, parse_time

_OF_BOX = ("x", "y", "width", "height")
LEAST_SQUARE = 8
"""Pixels of a side of the squares that are blurred."""
PROVEN_TOGETHER = 300
"""Changed images of which untouched blocks are proven together, unless the rules say otherwise."""


def _time(text: Any) -> Time | None:
    try:
        return None if text is None else parse_time(text)
    except OptionError as error:
        raise ValueError(str(error).rstrip(".")) from None


_TimeText = Annotated[Time | None, BeforeValidator(_time)]
_Place = Annotated[int, Field(ge=0, lt=2**31)]
_Side = Annotated[int, Field(ge=1, lt=2**31)]


class Rule(BaseModel):
    """A box of images of some topics, during a time."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    topic: str
    start: _TimeText = None
    end: _TimeText = None
    box: tuple[_Place, _Place, _Side, _Side]
    fill: float | tuple[float, ...] = 0.0
    blur: Annotated[int, Field(ge=LEAST_SQUARE, lt=2**31)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Rule:
        if self.blur is not None and "fill" in self.model_fields_set:
            raise ValueError("give blur or fill, not both")
        start, end = self.start, self.end
        if start and end and start.from_start == end.from_start and end.ns <= start.ns:
            raise ValueError(f"its range is empty: from {start} to {end}")
        return self


class Rules(BaseModel):
    """A file of rules."""

    model_config = ConfigDict(extra="forbid")

    rules: Annotated[list[Rule], Field(min_length=1)]
    proof: Annotated[int, Field(ge=0)] = PROVEN_TOGETHER
    keep_rules: bool = False


def load_rules(path: Path) -> tuple[Rules, bytes]:
    """Read a file of rules.

    Returns:
        The rules, and the file.

    Raises:
        OptionError: It cannot be read, or is not valid; says where.
    """
    most = yamlio.MAX_STRUCTURE_BYTES
    try:
        if path.exists() and not path.is_file():
            raise OptionError(f"{path} is not a file of rules.")
        with path.open("rb") as file:
            data = file.read(most + 1)
        if len(data) > most:
            raise OptionError(f"{path} has more than {most} bytes: give a function instead.")
        found = Rules.model_validate(yamlio.build(data.decode(), _scalar))
    except OSError as error:
        raise OptionError(f"{path} cannot be read: {error.strerror}.") from None
    except ValidationError as error:
        key, problem = model_problems(error)[0]
        names = key.split(".")
        if names[0] == "rules" and names[1:]:
            names[:2] = [f"rule {int(names[1]) + 1}"]
        if names[1:2] == ["box"] and names[2:]:
            names[1:] = ["box " + _OF_BOX[int(names[2])]]
        raise OptionError(f"{path}: {', '.join(names)}: {problem}.") from None
    except OptionError:
        raise
    except ValueError as error:
        raise OptionError(f"{path} is not valid YAML: {error}.") from None
    return found, data


def _scalar(event: Any) -> str | None:
    """A value as written, such as a time with all of its digits; None for none."""
    is_none = not event.style and yamlio.WORDS.get(event.value, "") is None
    return None if is_none else event.value
