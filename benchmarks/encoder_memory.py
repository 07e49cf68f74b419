"""How much memory encoders take, against the estimate that packing plans with.

    python benchmarks/encoder_memory.py [--case NAME ...] [--size WxH ...] [--threads N ...]
        [--gop N] [--noise N] [--gigabytes N]
    python benchmarks/encoder_memory.py --packets

Each encoder runs in a process of its own, on a panned scene with noise (a standard deviation of
1 % of the range by default), for enough frames to fill what it looks ahead. Measured is how far
the peak of resident memory is above what the process had before the encoder was made: all that it
and the pictures on their way take. What glibc counts as allocated is more where buffers were not
used: SVT-AV1 hands pictures out to its threads, and with few cores not all are ever in use.
Encoders whose estimate is above ``--gigabytes`` (a third of the free memory by default) are left
out.

``--packets`` instead compares the packets that encoders make with 1, 2, 4 and 8 threads.

Linux only (it reads /proc).
"""

from __future__ import annotations

import argparse
import ctypes
import hashlib
import json
import os
import resource
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from measure import parse_size, print_machine, print_table, python

SIZES = [(640, 480), (1440, 1080), (2448, 2048)]
THREADS = [1, 2, 4, 8]
CRF = 18
_PAN = 64  # pixels that the scene is larger than a picture
_DEEP = {"gray10le": 10, "gray12le": 12, "gray14le": 14, "gray16le": 16}


@dataclass(frozen=True, slots=True)
class Case:
    """An encoder and what it is given.

    Attributes:
        picture_format: Pixel format of the pictures.
        codec: Name in the registry.
        lossless: Whether every sample returns.
        preset: The encoder's, or None for the recipe's own.
    """

    picture_format: str
    codec: str
    lossless: bool
    preset: str | None = None


CASES = {
    "x264 gray": Case("gray", "h264", True),
    "x264 gray10": Case("gray10le", "h264", True),
    "x264 4:2:0": Case("yuv420p", "h264", True),
    "x264 4:2:2": Case("yuv422p", "h264", True),
    "x264 4:4:4": Case("yuv444p", "h264", True),
    "x264 rgb": Case("rgb24", "h264", True),
    "x265 gray10": Case("gray10le", "h265", True),
    "x265 gray12": Case("gray12le", "h265", True),
    "ffv1 gray": Case("gray", "ffv1", True),
    "ffv1 gray10": Case("gray10le", "ffv1", True),
    "ffv1 gray16": Case("gray16le", "ffv1", True),
    "ffv1 4:2:0": Case("yuv420p", "ffv1", True),
    "ffv1 rgb": Case("rgb24", "ffv1", True),
    "ffv1 rgba": Case("rgba", "ffv1", True),
    "ffv1 gbr10": Case("gbrp10le", "ffv1", True),
    "ffv1 gbr16": Case("gbrp16le", "ffv1", True),
    "ffv1 gbra16": Case("gbrap16le", "ffv1", True),
    "svt 4": Case("rgb24", "av1", False, "4"),
    "svt 6": Case("rgb24", "av1", False, "6"),
    "svt 8": Case("rgb24", "av1", False, "8"),
    "svt 4, 10 bits": Case("rgb24", "av1-10bit", False, "4"),
    "svt 6, 10 bits": Case("rgb24", "av1-10bit", False, "6"),
    "svt 8, 10 bits": Case("rgb24", "av1-10bit", False, "8"),
    "x264 medium": Case("rgb24", "h264", False, "medium"),
    "x264 slow": Case("rgb24", "h264", False, "slow"),
    "x265 medium": Case("rgb24", "h265", False, "medium"),
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--case", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--size", type=parse_size, nargs="+", default=SIZES, help="WxH")
    parser.add_argument("--threads", type=int, nargs="+", default=THREADS)
    parser.add_argument("--gop", type=int, default=60)
    parser.add_argument("--noise", type=float, default=1.0, help="standard deviation, %% of range")
    parser.add_argument("--gigabytes", type=float, default=_free_bytes() / 3e9)
    parser.add_argument("--packets", action="store_true", help="compare packets instead")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(_child(**json.loads(options.child))), flush=True)
        os._exit(0)  # without the pictures that are still in the encoder
    print_machine()
    common = {"gop": options.gop, "noise": options.noise}
    if options.packets:
        print_table(("case", *(f"{n} threads" for n in THREADS)), packets(options.case, common))
    else:
        header = (
            "case",
            "size",
            "threads",
            "frames",
            "MB",
            "allocated",
            "estimate",
            "ratio",
            "CPU s",
        )
        limit = options.gigabytes * 1e9
        print_table(header, sizes(options.case, options.size, options.threads, limit, common))


def _free_bytes() -> int:
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def sizes(
    names: Sequence[str],
    pictures: Sequence[tuple[int, int]],
    threads: Sequence[int],
    limit: float,
    common: dict[str, Any],
) -> Iterator[tuple[object, ...]]:
    """Measured and estimated memory of each case, MB."""
    from mp4ds.video.trial import encoder_bytes

    for name in names:
        for size in pictures:
            for count in threads:
                estimate = encoder_bytes(_recipe(CASES[name]), *size, threads=count)
                told = (name, f"{size[0]}x{size[1]}", count)
                if estimate > limit:
                    yield (*told, "", "", "", f"{estimate / 1e6:.0f}", "", "")
                    continue
                frames = _frames(CASES[name], size, count)
                run = _measure(name, size=size, threads=count, frames=frames, **common)
                yield (
                    *(*told, frames, f"{run['peak'] / 1e6:.0f}", f"{run['allocated'] / 1e6:.0f}"),
                    *(
                        f"{estimate / 1e6:.0f}",
                        f"{estimate / run['peak']:.2f}",
                        f"{run['cpu']:.0f}",
                    ),
                )


def packets(names: Sequence[str], common: dict[str, Any]) -> Iterator[tuple[object, ...]]:
    """Bytes of all packets for each number of threads; the same letter where they are equal."""
    for name in names:
        seen: list[str] = []
        cells = []
        for count in THREADS:
            run = _measure(name, size=(640, 480), threads=count, frames=70, finish=True, **common)
            if run["digest"] not in seen:
                seen.append(run["digest"])
            cells.append(f"{run['bytes']} {chr(ord('A') + seen.index(run['digest']))}")
        yield name, *cells


def _frames(case: Case, size: tuple[int, int], threads: int) -> int:
    """Frames that fill what an encoder looks ahead."""
    ahead = 60 if case.codec in ("h264", "h265") and not case.lossless else 16
    if case.codec.startswith("av1"):
        ahead = {1: 106, 2: 106, 3: 106, 4: 139, 5: 172}.get(threads, 337)
    elif case.codec == "h265":
        ahead += threads
    return max(ahead + 8, 120 if size[0] * size[1] < 1e6 else 0)


def _measure(name: str, **arguments: Any) -> dict[str, Any]:
    """Run `_child` in a process of its own."""
    run = python(__file__, "--child", json.dumps({"name": name, **arguments}))
    result: dict[str, Any] = json.loads(run.output.splitlines()[-1])
    return result


# ---------------------------------------------------------------- in the child


def _recipe(case: Case) -> Any:
    from mp4ds.video.codecs import recipe_for

    return recipe_for(
        case.picture_format,
        lossless=case.lossless,
        codec=case.codec,
        crf=None if case.lossless else CRF,
        preset=case.preset,
    )


class Scene:
    """Pictures of a scene of blobs of all sizes, panned, with noise.

    Args:
        picture_format: Of the pictures.
        width: Columns.
        height: Rows.
        noise: Standard deviation, percent of the range.
    """

    def __init__(self, picture_format: str, width: int, height: int, noise: float) -> None:
        from mp4ds.messages.arrangements import CHROMA_SHIFTS

        bits = _DEEP.get(picture_format, 8)
        if picture_format.startswith("gbr"):
            bits = int(picture_format.removesuffix("le")[-2:])
        self._shifts = CHROMA_SHIFTS.get(picture_format)
        self._planes = {"gbra": 4, "gbrp": 3}.get(picture_format[:4], 1)
        self._channels = {"rgb24": 3, "rgba": 4}.get(picture_format, 0)
        self._size = height, width
        self._rng = np.random.default_rng(1)
        shape = height + _PAN, width + _PAN
        dtype = np.uint16 if bits > 8 else np.uint8
        top = 2**bits - 1
        self._scene = _blobs(shape, top, self._rng).astype(dtype)
        all_channels = (*shape, self._channels) if self._channels else shape
        deviations = self._rng.standard_normal(all_channels, np.float32) * (top * noise / 100)
        # wraps: adding it to unsigned samples subtracts where it is negative
        self._noise = np.rint(deviations).astype(np.int32).astype(dtype)

    def picture(self, number: int) -> tuple[NDArray[Any], ...]:
        """The picture of a number, as layouts give them."""
        if self._shifts is None:
            return tuple(self._plane(number) for _ in range(self._planes))
        across, down = self._shifts
        chroma = (slice(None, None, 1 << down), slice(None, None, 1 << across))
        luma, blue, red = (self._plane(number) for _ in range(3))
        return luma, np.ascontiguousarray(blue[chroma]), np.ascontiguousarray(red[chroma])

    def _plane(self, number: int) -> NDArray[Any]:
        plane = self._cut(self._scene, 3 * number % _PAN, 2 * number % _PAN)
        if self._channels:
            plane = plane[:, :, None]
        row, column = self._rng.integers(0, _PAN, 2)
        noisy: NDArray[Any] = plane + self._cut(self._noise, row, column)
        return noisy

    def _cut(self, pixels: NDArray[Any], row: int, column: int) -> NDArray[Any]:
        height, width = self._size
        return pixels[row : row + height, column : column + width]


def _blobs(shape: tuple[int, int], top: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Values from 10 to 90 % of the range, with less contrast the smaller the detail."""
    sum_of_all: NDArray[np.float32] = np.zeros(shape, np.float32)
    for side in (4, 8, 16, 32, 64, 128, 256):
        coarse = rng.standard_normal([-(-n // side) for n in shape], np.float32)
        blocks = np.kron(coarse, np.ones((side, side), np.float32))
        sum_of_all += blocks[: shape[0], : shape[1]] * side**0.7
    lowest, highest = sum_of_all.min(), sum_of_all.max()
    values: NDArray[np.float32] = (sum_of_all - lowest) * (0.8 * top / (highest - lowest))
    values += 0.1 * top
    return values


class _Allocations(ctypes.Structure):
    """``struct mallinfo2`` of glibc."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
            *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
        )
    ]  # fmt: skip


def _allocated() -> int:
    """Bytes that glibc has given out; 0 where another library allocates."""
    try:
        mallinfo = ctypes.CDLL(None).mallinfo2
    except AttributeError:
        return 0
    mallinfo.restype = _Allocations
    found = mallinfo()
    return int(found.uordblks + found.hblkhd)


def _resident(key: str) -> int:
    """Bytes now (``VmRSS``) or at most (``VmHWM``)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(key)) * 1024


def _child(
    name: str,
    size: tuple[int, int],
    threads: int,
    frames: int,
    gop: int,
    noise: float,
    finish: bool = False,
) -> dict[str, Any]:
    """Encode; leaves the encoder open unless it is to be finished."""
    from mp4ds.video.encoder import VideoEncoder

    case = CASES[name]
    recipe = _recipe(case)
    scene = Scene(case.picture_format, *size, noise)
    scene.picture(0)
    with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
        path = Path(folder) / "video.mp4"
        resident, allocated, cpu = _resident("VmRSS"), _allocated(), _cpu()
        Path("/proc/self/clear_refs").write_text("5")  # forgets the peak
        encoder = VideoEncoder(
            path, recipe, picture_format=case.picture_format, width=size[0], height=size[1],
            gop=gop, threads=threads, rate=30.0,
        )  # fmt: skip
        for number in range(frames):
            encoder.write(scene.picture(number), 3000 * number)
        result = {"allocated": _allocated() - allocated}
        if finish:
            encoder.close()
            result |= _packets_of(path)
        return {**result, "peak": _resident("VmHWM") - resident, "cpu": _cpu() - cpu}


def _packets_of(path: Path) -> dict[str, Any]:
    """Bytes and digest of a video's packets."""
    import av

    digest, size = hashlib.sha256(), 0
    with av.open(str(path)) as container:
        for packet in container.demux(video=0):
            size += packet.size
            digest.update(bytes(packet))
    return {"bytes": size, "digest": digest.hexdigest()}


def _cpu() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
