"""Quality scores of frames, as a file gives them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError
from mp4ds.streams import Stream

Scores = Mapping[str, NDArray[np.float32]]
"""By the name of the measure; one for each frame, NaN where there is none."""

_MOST_BYTES = 2**30
_MOST_MEASURES = 16


def read_scores(path: Path) -> dict[str, dict[str, NDArray[np.float32]]]:
    """Scores of streams, from a JSON file ``{TOPIC: {MEASURE: [number or null, ...]}}``.

    Args:
        path: The file.

    Returns:
        By topic or name of a stream's file.

    Raises:
        OptionError: It cannot be read, or is no such file.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise OptionError(f"--scores {path} has more than {_MOST_BYTES} bytes.")
        found = json.loads(path.read_bytes())
    except OSError as error:
        raise OptionError(f"--scores {path} cannot be read: {error.strerror}.") from None
    except (ValueError, RecursionError):
        raise OptionError(f"--scores {path} is no JSON.") from None
    if not isinstance(found, dict):
        raise _unlike(path)
    return {topic: _measures(path, measures) for topic, measures in found.items()}


def _measures(path: Path, measures: object) -> dict[str, NDArray[np.float32]]:
    if not isinstance(measures, dict) or len(measures) > _MOST_MEASURES:
        raise _unlike(path)
    made = {}
    for name, values in measures.items():
        is_list = isinstance(values, list) and all(
            value is None or (isinstance(value, int | float) and not isinstance(value, bool))
            for value in values
        )
        if not is_list:
            raise _unlike(path)
        with np.errstate(over="ignore"):
            numbers = [np.nan if value is None else float(value) for value in values]
            made[name] = np.array(numbers, np.float32)
    return made


def _unlike(path: Path) -> OptionError:
    return OptionError(
        f'--scores {path} is not of the form {{"/topic": {{"vmaf": [98.7, null, ...]}}}}, with at '
        f"most {_MOST_MEASURES} measures of a topic."
    )


def scores_of(stream: Stream, scores: Mapping[str, Scores]) -> Scores:
    """The scores of one stream.

    Raises:
        OptionError: There are not as many as frames.
    """
    found = scores.get(stream.path.stem) or scores.get(stream.topic) or {}
    for name, values in found.items():
        if len(values) != len(stream):
            raise OptionError(
                f"{stream.topic} has {len(stream)} frames, and {len(values)} scores {name!r}: "
                "give one for each frame, null where there is none."
            )
    return found
