"""Colours that a driver made of a mosaic, or of YUV, by a fixed rule: back to what it had."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import Refused
from mp4ds.messages.encodings import (
    Encoding,
    LayoutParameters,
    Pixels,
    Samples,
    Values,
    native,
    patterns,
)

_BANDS = 6  # places of an image that are looked at first


def _colours(pixels: Pixels, encoding: Encoding) -> Pixels:
    """A view with R, G and B in this order."""
    return pixels if encoding.name.startswith("rgb") else pixels[..., ::-1]


def _band_rows(rows: int) -> Iterator[slice]:
    """A few places of an image, each of six rows from an even one."""
    for top in {rows * n // _BANDS // 2 * 2 for n in range(_BANDS)}:
        yield slice(top, top + 6)


# ---------------------------------------------------------------- mosaics

MOSAICS = ("rggb", "bggr", "gbrg", "grbg")
"""The colours of the 2 x 2 block, by rows."""

_FEWEST = 3  # rows and columns of an image that has an inside


def _demosaic(mosaic: Samples, block: str, rgb: Pixels) -> None:
    """Write the colours of a mosaic, bilinearly; at the edges, those of the pixel inside."""
    if min(mosaic.shape) < _FEWEST:
        rgb[...] = 0
        return
    wide: Samples = mosaic.astype(np.uint16 if mosaic.itemsize == 1 else np.uint32)
    inside = rgb[1:-1, 1:-1]
    across, down = wide[1:-1, :-2] + wide[1:-1, 2:], wide[:-2, 1:-1] + wide[2:, 1:-1]
    rows = wide[:, :-2] + wide[:, 2:]
    around, corners = (across + down + 2) >> 2, (rows[:-2] + rows[2:] + 2) >> 2
    across, down = (across + 1) >> 1, (down + 1) >> 1
    for y, x in product((0, 1), (0, 1)):
        place = np.s_[1 - y :: 2, 1 - x :: 2]
        color = "rgb".index(block[2 * y + x])
        target = inside[place]
        target[..., color] = wide[1:-1, 1:-1][place]
        if color == 1:
            beside = "rgb".index(block[2 * y + 1 - x])
            target[..., beside], target[..., 2 - beside] = across[place], down[place]
        else:
            target[..., 1], target[..., 2 - color] = around[place], corners[place]
    rgb[1:-1, 0], rgb[1:-1, -1] = rgb[1:-1, 1], rgb[1:-1, -2]
    rgb[0], rgb[-1] = rgb[1], rgb[-2]


def _sampled(rgb: Pixels, block: str) -> Samples:
    """The samples that a mosaic would have of these colours."""
    mosaic = np.empty(rgb.shape[:2], rgb.dtype)
    for y, x in product((0, 1), (0, 1)):
        mosaic[y::2, x::2] = rgb[y::2, x::2, "rgb".index(block[2 * y + x])]
    return mosaic


def _mosaic(rgb: Pixels, block: str) -> Samples:
    """The mosaic whose colours an image may be."""
    mosaic = _sampled(rgb, block)
    if min(mosaic.shape) <= _FEWEST:
        return mosaic
    sites = _sampled(np.broadcast_to(np.arange(3, dtype=np.uint8), rgb.shape), block)
    for turns in range(4):
        _find_edge(*(np.rot90(plane, turns) for plane in (mosaic, sites, rgb)))
    for turns in range(4):
        _find_corner(*(np.rot90(plane, turns) for plane in (mosaic, sites, rgb)))
    return mosaic


def _find_edge(mosaic: Samples, sites: Samples, rgb: Pixels) -> None:
    """Find the first row of a mosaic, of which only the second row of its colours tells.

    There, green pixels have the mean of two rows, so that the site above is one of two values. The
    pixels between have a mean of four sites, which says what values go together.
    """
    top = int(np.iinfo(mosaic.dtype).max)
    rows, columns = mosaic[:3].astype(np.int64), np.arange(1, mosaic.shape[1] - 1)
    is_green = sites[1, 1:-1] == 1
    greens, others = columns[is_green], columns[~is_green]
    rest = rows[2, others] + rows[1, others - 1] + rows[1, others + 1]
    least = 4 * rgb[1, others, 1].astype(np.int64) - 2 - rest
    mosaic[0, others] = np.clip(np.clip(rows[2, others], least, least + 3), 0, top)
    if not len(greens):
        return
    color = sites[0, greens[0]]
    least = 2 * rgb[1, greens, color].astype(np.int64) - 1 - rows[2, greens]
    between = greens[:-1] + 1
    due = 4 * rgb[1, between, color].astype(np.int64) - 2
    due -= rows[2, between - 1] + rows[2, between + 1] + least[:-1] + least[1:]
    options = (least >= 0) + 2 * (least < top)
    # in the corners, a sample at the end of the range leaves room for the one beside both edges
    ends = int(least[0] > top // 2), int(least[-1] > top // 2)
    added = _chain(options.tolist(), np.clip(due, -4, 3).tolist(), ends)
    mosaic[0, greens] = np.clip(least + added, 0, top)


def _find_corner(mosaic: Samples, sites: Samples, rgb: Pixels) -> None:
    """Find the first sample of a mosaic, which the pixel inside may have a mean of."""
    if sites[1, 1] != 1:
        rest = int(mosaic[0, 2]) + int(mosaic[2, 0]) + int(mosaic[2, 2])
        sample = 4 * int(rgb[1, 1, sites[0, 0]]) - 1 - rest
        mosaic[0, 0] = min(max(sample, 0), int(np.iinfo(mosaic.dtype).max))


def _chain(options: list[int], least: list[int], ends: tuple[int, int]) -> list[int]:
    """Numbers 0 or 1, each sum of two neighbours being the least given, or up to 3 more.

    Args:
        options: For each number, 1 if it may be 0, plus 2 if it may be 1.
        least: For each sum.
        ends: The first and the last number, if they may be these.
    """
    first, last = (1 << end for end in ends)
    for mask in (options[0] & first, options[0]):
        reached = [mask]
        for option, bound in zip(options[1:], least, strict=True):
            reached.append(option & _beside(reached[-1], bound))
        if reached[-1]:
            break
    found = [(reached[-1] & last or reached[-1]) >> 1]
    for mask, bound in zip(reached[-2::-1], least[::-1], strict=True):
        found.append((mask & _beside(1 << found[-1], bound)) >> 1)
    return found[::-1]


@cache
def _beside(options: int, least: int) -> int:
    """The options of a number beside one with options."""
    return sum(
        1 << number
        for number in (0, 1)
        if any(options >> other & 1 and least <= number + other <= least + 3 for other in (0, 1))
    )


class Demosaiced(Values):
    """The mosaic of colours that were made of it by bilinear interpolation."""

    parameters = frozenset({"mosaic"})
    is_source = True

    def __init__(self, encoding: Encoding, given: LayoutParameters) -> None:
        super().__init__(encoding, given)
        if given.mosaic not in MOSAICS:
            raise ValueError(f"mosaic {given.mosaic!r} is not one of {', '.join(MOSAICS)}")
        self._mosaic = given.mosaic

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """One sample a pixel."""
        return pixels.shape[:2]

    def encode(self, pixels: Pixels) -> Samples:
        """New samples."""
        return _mosaic(_colours(native(pixels), self.encoding), self._mosaic)

    def predicted(self, prediction: Pixels) -> Samples:
        """The color that the mosaic has at each pixel."""
        return _sampled(_colours(prediction, self.encoding), self._mosaic)

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        _demosaic(samples, self._mosaic, _colours(patterns(out), self.encoding))

    def prove(self, pixels: Pixels) -> Samples:
        """The mosaic, if interpolation gives every colour."""
        made = np.empty(pixels.shape, native(pixels).dtype)
        samples = self.encode(pixels)
        self.decode(samples, made)
        if not np.array_equal(made, native(pixels)):
            raise Refused(f"it was not made of a mosaic ({self._mosaic})")
        return samples

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> LayoutParameters | None:
        """The only mosaic that explains the inside of a few places, if it explains all images."""
        candidates = [LayoutParameters(mosaic=mosaic) for mosaic in MOSAICS]
        found = [given for given in candidates if cls(encoding, given)._may_have_made(samples[0])]
        return cls.first_fitting(encoding, samples, *found) if len(found) == 1 else None

    def _may_have_made(self, pixels: Pixels) -> bool:
        for rows in _band_rows(len(pixels)):
            rgb = _colours(native(pixels[rows]), self.encoding)
            made = np.empty(rgb.shape, rgb.dtype)
            _demosaic(_mosaic(rgb, self._mosaic), self._mosaic, made)
            if not np.array_equal(made[2:-2, 2:-2], rgb[2:-2, 2:-2]):
                return False
        return True


# ---------------------------------------------------------------- YUV

_NEUTRAL = 128 << 8 | 128
_SPAN = 511  # values of the difference of two samples
_FEWEST_CHROMAS = 8  # that tell a rule from the others
_ROWS = 32  # at a time, likewise
_CHUNK = 8192  # places at a time, which a processor's cache holds
_AT_ONCE = 1024  # chromas
_HARD = 8  # places for which all chromas are tried
_REACH = 12  # around an estimate of the chroma, where it has two unknowns


@dataclass(frozen=True)
class Conversion:
    """YUV to RGB, in integers: sums of terms that each depend on one sample.

    Attributes:
        factors: Of Y - 16; then of V - 128 in red, of U - 128 and V - 128 in green, and of U - 128
            in blue.
        early: Bits by which each term is shifted to the right.
        late: Bits by which their sum is, rounded.
        is_black_cut: Whether Y below 16 counts as 16.
        is_green_subtracted: Whether the terms of green are shifted before their sign changes.
    """

    factors: tuple[int, int, int, int, int]
    early: int = 0
    late: int = 0
    is_black_cut: bool = False
    is_green_subtracted: bool = False

    def _term(self, factor: int, numbers: NDArray[np.int64]) -> Samples:
        if factor < 0 and self.is_green_subtracted:
            return -self._term(-factor, numbers)
        term: Samples = (factor * numbers >> self.early).astype(np.int32)
        return term

    @cached_property
    def luma(self) -> Samples:
        """The term of each Y, and what rounds the sum."""
        numbers = np.arange(256) - 16
        if self.is_black_cut:
            numbers = np.maximum(numbers, 0)
        return self._term(self.factors[0], numbers) + (1 << self.late >> 1)

    @cached_property
    def chroma(self) -> Samples:
        """The terms of R, G and B for each U and V, shape (3, 65536), at 256 U + V."""
        centred = np.arange(256) - 128
        red, green_u, green_v, blue = (self._term(f, centred) for f in self.factors[1:])
        zeros = np.zeros_like(red)
        by_u, by_v = np.stack([zeros, green_u, blue]), np.stack([red, green_v, zeros])
        terms: Samples = (by_u[:, :, None] + by_v[:, None, :]).reshape(3, -1)
        return terms

    def _fractions(self, *colours: int) -> Iterator[Samples]:
        """Terms of Y, apart from whole steps, that give all differences of colours there are."""
        yield np.zeros_like(self.chroma[0])
        if self.late:
            for color in colours:
                yield -self.chroma[color] % (1 << self.late)

    def _difference(self, fraction: Samples, one: int, other: int) -> Samples:
        chroma = self.chroma
        first, second = chroma[one] + fraction, chroma[other] + fraction
        found: Samples = (first >> self.late) - (second >> self.late)
        return found

    @cached_property
    def known(self) -> Samples:
        """256 U + V of a pixel without 0 and 255, at 511 (R - G) + B - G, from -255; or -1.

        No difference occurs with two of them.
        """
        found = np.full(_SPAN * _SPAN, -1, np.int32)
        for fraction in self._fractions(0, 1, 2):
            red, blue = (self._difference(fraction, color, 1) + 255 for color in (0, 2))
            is_near = (red >= 0) & (red < _SPAN) & (blue >= 0) & (blue < _SPAN)
            found[(_SPAN * red + blue)[is_near]] = np.flatnonzero(is_near)
        return found

    @cached_property
    def lines(self) -> Sequence[tuple[int, int, bool, Samples]]:
        """How the chroma of a pixel is found where red, green or blue is cut off, in this order.

        Two other colours; whether U, otherwise V, is tried; and 256 U + V, or -1, for the
        difference of these colours, from -255, and what is tried.
        """
        found = []
        for one, other, is_u in ((2, 1, False), (2, 0, False), (0, 1, True)):
            table = np.full((_SPAN, 256), -1, np.int32)
            tried = np.arange(65536) >> 8 if is_u else np.arange(65536) & 255
            for fraction in self._fractions(one, other):
                difference = self._difference(fraction, one, other) + 255
                is_near = (difference >= 0) & (difference < _SPAN)
                table[difference[is_near], tried[is_near]] = np.flatnonzero(is_near)
            found.append((one, other, is_u, table))
        return found

    def least_luma(self, colours: Samples, offsets: Samples) -> Samples:
        """The least Y for which colours reach these values, if any does."""
        due = (colours << self.late) - offsets - (1 << self.late >> 1)
        return 16 - ((-due << self.early) // self.factors[0])

    def colours(self, luma: Samples, chroma: Samples) -> Iterator[Samples]:
        """R, G and B, before they are limited to 0 to 255."""
        light = self.luma[luma]
        for terms in self.chroma:
            yield (light + terms[chroma]) >> self.late


CONVERSIONS = {
    "opencv": Conversion((1220542, 1673527, -409993, -852492, 2116026), late=20, is_black_cut=True),
    "librealsense": Conversion((298, 409, -100, -208, 516), early=8, is_green_subtracted=True),
    "swscale": Conversion((9539, 13075, -3209, -6660, 16525), early=13),
}
"""The rules of the registry."""


class _Solution:
    """The YUV of pixels that share chroma, as far as it was found.

    Args:
        rule: The conversion.
        colours: R, G and B, shape (3, pixels that share chroma, N), int32; the first pixel of each
            has neither 0 nor 255.

    Attributes:
        luma: Y, shape (pixels, N).
        chroma: 256 U + V, shape (N,).
        is_open: Where there is no solution yet, shape (N,).
    """

    def __init__(self, rule: Conversion, colours: Samples) -> None:
        _, sharing, count = colours.shape
        self.rule, self.colours = rule, colours
        self.luma, self.chroma = np.empty((sharing, count), np.int32), np.empty(count, np.int32)
        self.is_open = np.empty(count, bool)
        for start in range(0, count, _CHUNK):
            self._begin(slice(start, start + _CHUNK))

    def _begin(self, part: slice) -> None:
        rule, colours = self.rule, self.colours[:, :, part]
        red, green, blue = colours[:, 0]
        chroma = rule.known[(red - green) * _SPAN + (blue - green) + 255 * (_SPAN + 1)]
        chroma[chroma < 0] = _NEUTRAL
        luma = np.clip(rule.least_luma(colours[1], rule.chroma[1][chroma]), 0, 255)
        is_right = np.ones(len(chroma), bool)
        for made, color in zip(rule.colours(luma, chroma), colours, strict=True):
            is_right &= (made == color).all(axis=0)
        self.luma[:, part], self.chroma[part], self.is_open[part] = luma, chroma, ~is_right

    @property
    def is_refuted(self) -> bool:
        """Whether there is none for some pixels without 0 and 255."""
        left = self.colours[:, :, self.is_open]
        return bool(((left > 0) & (left < 255)).all(axis=(0, 1)).any())

    def complete(self) -> None:
        """Find the rest, where colours are cut off at 0 or 255."""
        where = np.flatnonzero(self.is_open)
        if not len(where):
            return
        colours = self.colours[:, :, where]
        is_cut = (colours == 0) | (colours == 255)
        place = np.arange(len(where))
        best = is_cut.sum(axis=0).argmin(axis=0)  # the pixel with most colours as they were
        pixel, cut = colours[:, best, place], is_cut[:, best, place]
        count, estimate = cut.sum(axis=0), _estimate(pixel)
        red, green, blue = pixel
        known = self.rule.known[(red - green) * _SPAN + (blue - green) + 255 * (_SPAN + 1)]
        self._try(where[count == 0], known[count == 0, None])
        self._try(where[count == 3], np.full(((count == 3).sum(), 1), _NEUTRAL))
        for color, (one, other, is_u, table) in enumerate(self.rule.lines):
            picked = np.flatnonzero((count == 1) & cut[color])
            difference = pixel[one, picked] - pixel[other, picked] + 255
            # beyond the estimate, which is for a colour at the limit
            is_up = (pixel[color, picked] == 255) != (color == 1)
            step = np.where(is_up, 1, -1)
            start = estimate[1 - is_u, picked]
            for place, number in self._turns(where[picked], len(_STEPS)):
                tried = start[place, None] + step[place, None] * _STEPS[number]
                found = table[difference[place, None], np.clip(tried, 0, 255)]
                is_inside = (tried >= 0) & (tried < 256)
                self._try(where[picked[place]], np.where(is_inside, found, -1))
        several = np.flatnonzero(count >= 2)
        middle = np.mean([_estimate(colours[:, n]) for n in range(colours.shape[1])], axis=0)
        for centre in (middle.astype(np.int32), estimate):
            for place, number in self._turns(where[several], len(_AROUND)):
                u, v = centre[:, several[place], None] + _AROUND[number].T[:, None]
                is_inside = (np.minimum(u, v) >= 0) & (np.maximum(u, v) < 256)
                self._try(where[several[place]], np.where(is_inside, 256 * u + v, -1))
        hard = np.flatnonzero(self.is_open)[:_HARD]
        self._try(hard, np.broadcast_to(np.arange(65536), (len(hard), 65536)))

    def _turns(self, places: Samples, count: int) -> Iterator[tuple[Samples, slice]]:
        """Which of some places are open, and the numbers to try next, more of them for fewer."""
        start = 0
        while start < count and (left := np.flatnonzero(self.is_open[places])).size:
            end = start + max(1, _AT_ONCE // len(left))
            yield left, slice(start, end)
            start = end

    def _try(self, places: Samples, chroma: Samples) -> None:
        """Take the first chroma that is the solution of each place; -1 is none."""
        chroma = chroma[:, ::-1]  # so that the first is written last
        places = np.repeat(places, chroma.shape[1])
        places, chroma = places[chroma.ravel() >= 0], chroma[chroma >= 0]
        if not len(places):
            return
        colours = self.colours[:, :, places]
        is_black = (colours == 0).all(axis=0)
        due = np.where(is_black, 1, colours)
        offsets = self.rule.chroma[:, chroma][:, None]
        least = self.rule.least_luma(due, offsets)
        most = np.where(due > 0, least, -256).max(axis=0)
        luma = np.clip(np.where(is_black, least.min(axis=0) - 1, most), 0, 255)
        is_right = np.ones(len(chroma), bool)
        for made, color in zip(self.rule.colours(luma, chroma), colours, strict=True):
            is_right &= (np.clip(made, 0, 255) == color).all(axis=0)
        done = places[is_right]
        self.luma[:, done], self.chroma[done] = luma[:, is_right], chroma[is_right]
        self.is_open[done] = False


_STEPS = np.array([*range(-1, 260), -2, -3, -4])
_AROUND = np.array(
    sorted(product(range(-_REACH, _REACH + 1), repeat=2), key=lambda pair: max(map(abs, pair)))
)


def _estimate(colours: Samples) -> Samples:
    """About U and V of colours, shape (2, N)."""
    red, green, blue = colours
    u = (-38 * red - 74 * green + 112 * blue >> 8) + 128
    v = (112 * red - 94 * green - 18 * blue >> 8) + 128
    return np.stack([u, v])


class Converted(Values):
    """The YUV, chroma halved, of colours that were made of it."""

    parameters = frozenset({"rule"})
    is_source = True
    is_tall = False  # whether chroma is halved in height, too

    def __init__(self, encoding: Encoding, given: LayoutParameters) -> None:
        super().__init__(encoding, given)
        if given.rule not in CONVERSIONS:
            raise ValueError(f"rule {given.rule!r} is not one of {', '.join(CONVERSIONS)}")
        self._conversion = CONVERSIONS[given.rule]

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """As YUYV or NV12 have it."""
        height, width = pixels.shape[:2]
        return (height * 3 // 2, width) if self.is_tall else (height, width, 2)

    def _solved(self, pixels: Pixels) -> _Solution:
        height, width = pixels.shape[:2]
        down = 1 + self.is_tall
        rgb = _colours(pixels, self.encoding)
        colours = np.empty((3, down, 2, height // down, width // 2), np.int32)
        for color, y, x in product(range(3), range(down), (0, 1)):
            colours[color, y, x] = rgb[y::down, x::2, color]
        return _Solution(self._conversion, colours.reshape(3, 2 * down, -1))

    def _planes(self, samples: Samples) -> tuple[Samples, Samples, Samples]:
        """Views of Y, U and V."""
        if not self.is_tall:
            return samples[..., 0], samples[:, 0::2, 1], samples[:, 1::2, 1]
        rows = len(samples) * 2 // 3
        return samples[:rows], samples[rows:, 0::2], samples[rows:, 1::2]

    def encode(self, pixels: Pixels) -> Samples:
        """New samples."""
        solution = self._solved(pixels)
        solution.complete()
        return self._placed(solution, pixels)

    def _placed(self, solution: _Solution, pixels: Pixels) -> Samples:
        samples = np.empty(self.shape(pixels), np.uint8)
        luma, u, v = self._planes(samples)
        down = 1 + self.is_tall
        placed = solution.luma.reshape(down, 2, *u.shape).transpose(2, 0, 3, 1)
        luma[...] = placed.reshape(luma.shape)
        chroma = solution.chroma.reshape(u.shape)
        u[...], v[...] = chroma >> 8, chroma & 255
        return samples

    def predicted(self, prediction: Pixels) -> Samples:
        """About the YUV of these colours: one rule for all."""
        samples = np.empty(self.shape(prediction), np.uint8)
        rgb = _colours(prediction, self.encoding)
        luma, u, v = self._planes(samples)
        halvings = 1 + self.is_tall
        middle = 0x8080 << halvings
        for top in range(0, len(rgb), _ROWS):
            colours = [rgb[top : top + _ROWS, :, n].astype(np.uint16) for n in range(3)]
            weighted = [
                weight * color for weight, color in zip((66, 129, 25), colours, strict=True)
            ]
            luma[top : top + _ROWS] = (sum(weighted) + 0x1080) >> 8
            sums = [color[:, 0::2] + color[:, 1::2] for color in colours]
            if self.is_tall:
                sums = [rows[0::2] + rows[1::2] for rows in sums]
            red, green, blue = (total.astype(np.int32) for total in sums)
            place = slice(top >> self.is_tall, (top + _ROWS) >> self.is_tall)
            u[place] = (-38 * red - 74 * green + 112 * blue + middle) >> (8 + halvings)
            v[place] = (112 * red - 94 * green - 18 * blue + middle) >> (8 + halvings)
        return samples

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        luma, u, v = self._planes(samples)
        down = 1 + self.is_tall
        blocks = luma.reshape(len(u), down, -1, 2)
        chroma = (256 * u.astype(np.int32) + v)[:, None, :, None]
        target = _colours(out, self.encoding)
        for color, made in enumerate(self._conversion.colours(blocks, chroma)):
            target[..., color] = np.clip(made, 0, 255).reshape(luma.shape)

    def prove(self, pixels: Pixels) -> Samples:
        """The YUV, if there is one for every colour."""
        if pixels.shape[1] % 2 or (self.is_tall and pixels.shape[0] % 2):
            raise Refused("it has an odd side")
        solution = self._solved(pixels)
        if not solution.is_refuted:
            solution.complete()
        if solution.is_open.any():
            raise Refused(f"it was not made of YUV ({self.given.rule})")
        return self._placed(solution, pixels)

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> LayoutParameters | None:
        """The rule that explains a few places with several chromas, and all images."""
        height, width = samples[0].shape[:2]
        if width % 2 or (cls.is_tall and height % 2):
            return None
        places = np.concatenate([samples[0][rows] for rows in _band_rows(height)])
        candidates = [LayoutParameters(rule=rule) for rule in CONVERSIONS]
        likely = []
        for given in candidates:
            solution = cls(encoding, given)._solved(places)
            if not solution.is_refuted and len(np.unique(solution.chroma)) >= _FEWEST_CHROMAS:
                likely.append(given)
        return cls.first_fitting(encoding, samples, *likely)


class ConvertedTall(Converted):
    """That whose chroma is halved in height, too."""

    is_tall = True
