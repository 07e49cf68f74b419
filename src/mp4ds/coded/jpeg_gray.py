"""Grey images as JPEG files of one component, which ffmpeg's encoder does not make.

Baseline, sequential (ITU-T T.81): the tables are those of its annex K, the quantisation scaled
by a quality from 1 to 100 as libjpeg does it, so files are as large and as good as libjpeg's.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from mp4ds.coded.base import check_size

_SIDE = 8  # of a block
_LARGEST = 1023  # coefficient that the code has a category for
_WORD = 32  # bits of the words that codes are gathered in
_EOB, _ZRL = 0x00, 0xF0  # end of block, and sixteen zeros
_DC = 0  # place of a block's mean among its coefficients

# the order of T.81, figure A.6: along the diagonals, up and down in turn
_ZIGZAG = np.array(
    sorted(
        range(64),
        key=lambda n: (n // 8 + n % 8, n // 8 if (n // 8 + n % 8) % 2 else n % 8),
    )
)
_LUMINANCE = np.array(
    [
        *(16, 11, 10, 16, 24, 40, 51, 61),
        *(12, 12, 14, 19, 26, 58, 60, 55),
        *(14, 13, 16, 24, 40, 57, 69, 56),
        *(14, 17, 22, 29, 51, 87, 80, 62),
        *(18, 22, 37, 56, 68, 109, 103, 77),
        *(24, 35, 55, 64, 81, 104, 113, 92),
        *(49, 64, 78, 87, 103, 121, 120, 101),
        *(72, 92, 95, 98, 112, 100, 103, 99),
    ]
)  # table K.1
# How many codes there are of 1 to 16 bits, and what they stand for: tables K.3 and K.5
_DC_CODES = (bytes.fromhex("00010501010101010100000000000000"), bytes(range(12)))
_AC_CODES = (
    bytes.fromhex("0002010303020403050504040000017d"),
    bytes.fromhex(
        "01020300041105122131410613516107227114328191a1082342b1c11552d1f02433627282090a161718191a25"
        "262728292a3435363738393a434445464748494a535455565758595a636465666768696a737475767778797a83"
        "8485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3"
        "d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa"
    ),
)

_Integers = NDArray[np.int64]


def encode(pixels: NDArray[np.uint8], quality: int) -> bytes:
    """A JPEG file of a grey image.

    Args:
        pixels: Shape (H, W).
        quality: 1 to 100, as libjpeg has it.

    Raises:
        ValueError: There is no such quality.
        Refused: A side is beyond what a video has.
    """
    if not 1 <= quality <= 100:
        raise ValueError(f"a JPEG quality of {quality}, not of 1 to 100")
    height, width = pixels.shape
    check_size(width, height)
    steps = _quantisation(quality)
    coefficients = _transform(pixels, steps)
    codes, lengths = _codes_of(coefficients)
    return b"".join(
        (
            b"\xff\xd8",
            _segment(0xE0, b"JFIF\0\1\1\0\0\1\0\1\0\0"),
            _segment(0xDB, b"\0" + steps[_ZIGZAG].astype(np.uint8).tobytes()),
            _segment(0xC0, struct.pack(">BHHBBBB", 8, height, width, 1, 1, 0x11, 0)),
            _segment(0xC4, b"\x00" + b"".join(_DC_CODES) + b"\x10" + b"".join(_AC_CODES)),
            _segment(0xDA, b"\1\1\0\0\x3f\0"),
            _gather(codes, lengths).replace(b"\xff", b"\xff\0"),
            b"\xff\xd9",
        )
    )


def _segment(marker: int, content: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, 2 + len(content)) + content


def _quantisation(quality: int) -> _Integers:
    """The steps by which the 64 coefficients are divided, by rows."""
    percent = 5000 // quality if quality < 50 else 200 - 2 * quality
    steps: _Integers = np.clip((_LUMINANCE * percent + 50) // 100, 1, 255)
    return steps


def _transform(pixels: NDArray[np.uint8], steps: _Integers) -> _Integers:
    """The quantised coefficients of each block, shape (blocks, 64), in zigzag order."""
    height, width = pixels.shape
    padded = np.pad(pixels, ((0, -height % _SIDE), (0, -width % _SIDE)), mode="edge")
    rows, columns = (side // _SIDE for side in padded.shape)
    blocks = padded.reshape(rows, _SIDE, columns, _SIDE).swapaxes(1, 2)
    basis = _cosines()
    values = basis @ (blocks.astype(np.float32) - 128) @ basis.T
    scaled = values.reshape(-1, _SIDE * _SIDE)[:, _ZIGZAG] / steps[_ZIGZAG].astype(np.float32)
    quantised: _Integers = np.clip(np.rint(scaled), -_LARGEST, _LARGEST).astype(np.int64)
    return quantised


def _cosines() -> NDArray[np.float32]:
    """The discrete cosine transform of 8 values as a matrix (T.81, A.3.3)."""
    k, x = np.mgrid[:_SIDE, :_SIDE]
    basis: NDArray[np.float64] = np.cos((2 * x + 1) * k * np.pi / (2 * _SIDE)) / 2
    basis[0] /= np.sqrt(2)
    return basis.astype(np.float32)


def _codes_of(coefficients: _Integers) -> tuple[NDArray[np.uint64], _Integers]:
    """The codes of all blocks one after the other, and how many bits each has (T.81, F.1.2)."""
    values = coefficients.copy()
    values[:, _DC] = np.diff(coefficients[:, _DC], prepend=0)
    coded = values != 0
    coded[:, _DC] = True
    places = np.flatnonzero(coded)
    values = values.reshape(-1)[places]
    block, place = places // 64, places % 64
    is_dc = place == _DC
    is_last = np.append(block[1:] != block[:-1], True)
    zeros = np.diff(places, prepend=0) - 1
    zeros[is_dc] = 0
    # each coefficient has its code after one for every sixteen zeros, the last one of a block a
    # further code if zeros follow
    sixteens, has_end = zeros // 16, is_last & (place < 63)
    after = np.cumsum(sixteens + 1 + has_end)
    at = after - has_end - 1
    sizes = np.frexp(np.abs(values).astype(np.float64))[1].astype(np.int64)
    extra = np.where(values < 0, values + (1 << sizes) - 1, values).astype(np.uint64)
    dc_codes, dc_lengths = _table(*_DC_CODES)
    ac_codes, ac_lengths = _table(*_AC_CODES)
    symbols = (zeros % 16) << 4 | sizes
    prefixes = np.where(is_dc, dc_codes[symbols], ac_codes[symbols])
    codes = np.full(int(after[-1]), ac_codes[_ZRL])
    lengths = np.full(len(codes), ac_lengths[_ZRL])
    codes[at] = prefixes << sizes.astype(np.uint64) | extra
    lengths[at] = np.where(is_dc, dc_lengths[symbols], ac_lengths[symbols]) + sizes
    codes[at[has_end] + 1] = ac_codes[_EOB]
    lengths[at[has_end] + 1] = ac_lengths[_EOB]
    return codes, lengths


def _table(counts: bytes, symbols: bytes) -> tuple[NDArray[np.uint64], _Integers]:
    """Code and length of each symbol (T.81, annex C)."""
    codes, lengths = np.zeros(256, np.uint64), np.zeros(256, np.int64)
    code, remaining = 0, iter(symbols)
    for length, count in enumerate(counts, start=1):
        for _ in range(count):
            symbol = next(remaining)
            codes[symbol], lengths[symbol] = code, length
            code += 1
        code <<= 1
    return codes, lengths


def _gather(codes: NDArray[np.uint64], lengths: _Integers) -> bytes:
    """The codes as bytes, the last one filled up with ones.

    A code has at most 27 bits, so that it lies in two words, and one begins in every word.
    """
    ends = np.cumsum(lengths)
    starts = ends - lengths
    word, bit = starts // _WORD, starts % _WORD
    shifted = codes << (2 * _WORD - bit - lengths).astype(np.uint64)
    first = np.flatnonzero(np.diff(word, prepend=-1))
    words = np.zeros(int(word[-1]) + 2, np.uint64)
    words[:-1] = np.bitwise_or.reduceat(shifted >> np.uint64(_WORD), first)
    words[1:] |= np.bitwise_or.reduceat(shifted & np.uint64(2**_WORD - 1), first)
    total = int(ends[-1])
    data = bytearray(words.astype(">u4").tobytes()[: -(-total // 8)])
    data[-1] |= (1 << -total % 8) - 1
    return bytes(data)
