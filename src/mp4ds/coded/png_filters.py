"""PNG's row filters, undone and done again as an encoder chose them (PNG, 9 "Filtering").

Rows are arrays of bytes; "left" is the byte one pixel before, "above" that of the row before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from mp4ds.coded.base import Refused

Bytes = NDArray[np.uint8]
_Wide = NDArray[np.int16]

_NONE, _SUB, _UP, _AVERAGE, _PAETH = range(5)
_BAND_BYTES = 2**17  # of pixels filtered at once, to stay in the cache
_FRONT_BYTES = 2**26  # of pixels unfiltered at once


@dataclass(frozen=True, slots=True)
class Rule:
    """How an encoder chooses the filter of each row.

    Attributes:
        kinds: The filters tried, in order. The one whose bytes, taken as signed, have the
            smallest sum of absolute values is taken; of equal ones the first.
        first: Filter of the first row, if it is always the same.
        weight: What the number of a filter adds to its sum.
        narrow: Whether filters are left out for images of one row or column, as libpng does.
    """

    kinds: tuple[int, ...]
    first: int | None = None
    weight: int = 0
    narrow: bool = False


RULES = MappingProxyType(
    {
        "libpng": Rule((0, 1, 2, 3, 4), narrow=True),
        "libpng-fast": Rule((0, 1, 2), narrow=True),
        "pillow": Rule((0, 2, 1, 4)),
        "pillow-optimize": Rule((0, 2, 1, 3, 4)),
        "ffmpeg-mixed": Rule((0, 1, 2, 3, 4), first=_SUB, weight=1),
        **{str(kind): Rule((kind,)) for kind in range(5)},
        **{f"1,{kind}": Rule((kind,), first=_SUB) for kind in range(2, 5)},
    }
)
"""Name of a rule -> the rule. A number is the filter of all rows; after ``1,`` of all but one."""


def unfilter(rows: Bytes, pixel_bytes: int) -> Bytes:
    """Undo the filters.

    Args:
        rows: Shape (H, 1 + bytes of a row): a filter number before each row.
        pixel_bytes: Bytes of a pixel.

    Returns:
        Shape (H, bytes of a row).

    Raises:
        Refused: A filter number is unknown.
    """
    kinds = rows[:, 0]
    if kinds.max() > _PAETH:
        raise Refused(f"its PNG uses the unknown filter {kinds.max()}")
    if kinds.max() <= _UP:
        return _unfilter_simple(rows, pixel_bytes)
    out = np.empty((rows.shape[0], rows.shape[1] - 1), np.uint8)
    above = np.zeros(out.shape[1], np.uint8)
    band = max(64, _FRONT_BYTES // (4 * out.shape[1]))
    for start in range(0, len(rows), band):
        part = out[start : start + band]
        _unfilter_front(rows[start : start + band], above, pixel_bytes, part)
        above = part[-1]
    return out


def _unfilter_simple(rows: Bytes, pixel_bytes: int) -> Bytes:
    """Undo filters of which none needs two neighbours."""
    out: Bytes = rows[:, 1:].copy()
    kinds = rows[:, 0]
    subs = np.flatnonzero(kinds == _SUB)
    pixels = out[subs].reshape(len(subs), out.shape[1] // pixel_bytes, pixel_bytes)
    out[subs] = np.cumsum(pixels, axis=1, dtype=np.uint8).reshape(len(subs), out.shape[1])
    for row in np.flatnonzero(kinds == _UP):
        if row:
            out[row] += out[row - 1]
    return out


def _unfilter_front(rows: Bytes, above: Bytes, pixel_bytes: int, out: Bytes) -> None:
    """Undo any filters, along a front that moves over all rows at once.

    A pixel needs those left, above, and left above of it. On the front of pixels whose column
    and row have the same sum, none needs another.
    """
    height, width = len(rows), (rows.shape[1] - 1) // pixel_bytes
    steps = height + width - 1
    coded = np.zeros((steps, height, pixel_bytes), np.uint8)
    _slanted(coded, width)[...] = rows[:, 1:].reshape(height, width, pixel_bytes)
    # fronts[d + 2, y + 1] is the pixel (d - y, y); the row above stands at y = -1
    fronts = np.zeros((steps + 2, height + 1, pixel_bytes), np.int16)
    fronts[1 : width + 1, 0] = above.reshape(width, pixel_bytes)
    kinds = rows[:, 0][:, None]
    paeth = kinds == _PAETH
    all_paeth, any_paeth = bool(paeth.all()), bool(paeth.any())
    take_left = np.isin(kinds, (_SUB, _AVERAGE)).astype(np.int16)
    take_above = np.isin(kinds, (_UP, _AVERAGE)).astype(np.int16)
    halve = (kinds == _AVERAGE).astype(np.int16)
    for step in range(steps):
        left, up = fronts[step + 1, 1:], fronts[step + 1, :-1]
        if any_paeth:
            predicted = _paeth(left, up, fronts[step, :-1])
        if not all_paeth:
            linear = (left * take_left + up * take_above) >> halve
            predicted = np.where(paeth, predicted, linear) if any_paeth else linear
        np.bitwise_and(coded[step] + predicted, 255, out=fronts[step + 2, 1:])
    out[...] = _slanted(fronts[2:, 1:], width).reshape(height, -1)


def _slanted(fronts: NDArray[Any], width: int) -> NDArray[Any]:
    """Fronts, shape (steps, H, bytes), as the rows that cross them, shape (H, width, bytes)."""
    step, row, byte = fronts.strides
    return as_strided(fronts, (fronts.shape[1], width, fronts.shape[2]), (step + row, step, byte))


def _paeth(left: _Wide, above: _Wide, corner: _Wide) -> _Wide:
    """The neighbour nearest to left + above - corner; of equally near ones the first."""
    from_left = above - corner
    from_above = left - corner
    from_corner = np.abs(from_left + from_above)
    np.abs(from_left, out=from_left)
    np.abs(from_above, out=from_above)
    nearest: _Wide = np.where(from_above <= from_corner, above, corner)
    is_left = from_left <= from_above
    is_left &= from_left <= from_corner
    np.copyto(nearest, left, where=is_left)
    return nearest


def filter_rows(pixels: Bytes, pixel_bytes: int, rule: Rule) -> Bytes:
    """Filter rows as a rule says.

    Args:
        pixels: Shape (H, bytes of a row).
        pixel_bytes: Bytes of a pixel.
        rule: One of `RULES`.

    Returns:
        Shape (H, 1 + bytes of a row), with the filter number before each row.
    """
    height, row_bytes = pixels.shape
    out = np.empty((height, 1 + row_bytes), np.uint8)
    kinds = _kinds(rule, height, row_bytes // pixel_bytes)
    for start, stop, shifted in _bands(pixels):
        band = pixels[start:stop]
        if len(kinds) == 1:
            out[start:stop, 0] = kinds[0]
            out[start:stop, 1:] = _filtered(band, shifted, pixel_bytes, kinds[0])
            continue
        tried = np.stack([_filtered(band, shifted, pixel_bytes, kind) for kind in kinds])
        chosen = np.argmin(_sums(tried) + rule.weight * np.array(kinds)[:, None], axis=0)
        out[start:stop, 0] = np.array(kinds, np.uint8)[chosen]
        out[start:stop, 1:] = tried[chosen, np.arange(stop - start)]
    if rule.first is not None:
        nothing = np.zeros_like(pixels[:1])
        out[0, 0] = rule.first
        out[0, 1:] = _filtered(pixels[:1], nothing, pixel_bytes, rule.first)[0]
    return out


def find_rule(kinds: Bytes, pixels: Bytes, pixel_bytes: int) -> str | None:
    """The name of a rule that chooses these filters for these rows, or None.

    Args:
        kinds: The filter of each row.
        pixels: Shape (H, bytes of a row).
        pixel_bytes: Bytes of a pixel.
    """
    first, rest = int(kinds[0]), kinds[1:]
    if (kinds == first).all():
        return str(first)
    if first == _SUB and (rest == rest[0]).all() and f"1,{rest[0]}" in RULES:
        return f"1,{rest[0]}"
    for name, rule in RULES.items():
        if len(rule.kinds) > 1:
            sample = min(len(kinds), 1 + _BAND_BYTES // pixels.shape[1])
            if not np.array_equal(
                filter_rows(pixels[:sample], pixel_bytes, rule)[:, 0], kinds[:sample]
            ):
                continue
            if np.array_equal(filter_rows(pixels, pixel_bytes, rule)[:, 0], kinds):
                return name
    return None


def _kinds(rule: Rule, height: int, width: int) -> tuple[int, ...]:
    """The filters that a rule tries for an image of a size."""
    left_out: set[int] = set()
    if rule.narrow and height == 1:
        left_out |= {_UP, _AVERAGE, _PAETH}
    if rule.narrow and width == 1:
        left_out |= {_SUB, _AVERAGE, _PAETH}
    return tuple(kind for kind in rule.kinds if kind not in left_out)


def _bands(pixels: Bytes) -> Iterator[tuple[int, int, Bytes]]:
    """Spans of rows, with the rows above them."""
    height, row_bytes = pixels.shape
    rows = max(1, _BAND_BYTES // row_bytes)
    for start in range(0, height, rows):
        stop = min(start + rows, height)
        if start:
            yield start, stop, pixels[start - 1 : stop - 1]
        else:
            yield start, stop, np.concatenate((np.zeros_like(pixels[:1]), pixels[: stop - 1]))


def _filtered(band: Bytes, above: Bytes, pixel_bytes: int, kind: int) -> Bytes:
    if kind == _NONE:
        return band
    if kind == _UP:
        return band - above
    left = _moved(band, pixel_bytes)
    if kind == _SUB:
        return band - left
    if kind == _AVERAGE:
        # the mean, rounded down, without a carry
        return band - ((left & above) + ((left ^ above) >> 1))
    corner = _moved(above, pixel_bytes)
    wide = (part.astype(np.int16) for part in (left, above, corner))
    return band - _paeth(*wide).astype(np.uint8)


def _moved(rows: Bytes, pixel_bytes: int) -> Bytes:
    """Rows moved right by a pixel."""
    moved = np.zeros_like(rows)
    moved[:, pixel_bytes:] = rows[:, :-pixel_bytes]
    return moved


def _sums(tried: Bytes) -> NDArray[np.int64]:
    sums: NDArray[np.int64] = np.minimum(tried, -tried).sum(axis=2, dtype=np.int64)
    return sums
