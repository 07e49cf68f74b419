"""What packing costs those who look for features and tags in the frames, and what noise costs.

    python benchmarks/features.py [--frames N] [--size WxH] [--way NAME ...] [--clip NAME ...]

Clips are those of plane_clips.py: the camera's motion is known, so the truth is no codec's. Each
way of keeping the frames is measured on the same noisy frames as all others. Video is encoded and
decoded by the package; its bytes are those of a long video with a key frame every 60 frames.

    features   ORB and SIFT, up to 1000 of a frame. Of every second frame, or as `--every` says,
               those `STEP` apart are matched both ways, with a ratio test of 0.8.
    right      matches that are within 3 pixels of the truth: their share of all matches
               ("inliers"), and how many there are of a pair of frames
    error      distance of the right matches from the truth, pixels: median and 95th percentile
    corner     a homography is estimated from the matches (MAGSAC): distance of the frame's corners
               from where they truly are, pixels, mean of the four; median and 95th percentile of
               the pairs
    tags       AprilTags found of all, and the distance of their corners from the truth, pixels:
               median and 95th percentile. The detector pulls corners that a lens has rounded
               inwards, in the original, too; "jitter" is the distance from the mean error of each
               corner over the frames.
    PSNR       of the colours, against what the camera would have seen without noise, dB

A row is the mean over the clips of one noise. Then `visual` is compared with JPEG 90 clip by clip,
and the tools against noise with plain AV1 of preset 6 at equal size, along the curves of several
crf.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import clips
import plane_clips
from keeping import PLAIN, Frames, Way, kept, ways
from measure import parse_size, print_machine, print_table

Errors = NDArray[np.float64]

STEP = 4  # frames
_NEAR = 3.0  # pixels
_FEATURES, _RATIO = 1000, 0.8
_LOST = 100.0  # pixels: where no homography was found


# ---------------------------------------------------------------- measuring


@dataclass
class Measured:
    """One way on one clip. Names are those of the columns; errors in pixels.

    Attributes:
        size: Bytes of a frame.
        values: By the name of what was measured.
    """

    size: float
    values: dict[str, float] = field(default_factory=dict)


def features(frames: Frames, clip: plane_clips.PlaneClip, every: int) -> dict[str, float]:
    """ORB and SIFT of every so many frames against the truth."""
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames[::every]]
    kinds: dict[str, tuple[Any, int]] = {
        "ORB": (cv2.ORB_create(_FEATURES), cv2.NORM_HAMMING),
        "SIFT": (cv2.SIFT_create(_FEATURES), cv2.NORM_L2),
    }
    found = {}
    for kind, (detector, norm) in kinds.items():
        seen = [detector.detectAndCompute(picture, None) for picture in grey]
        places = [cv2.KeyPoint_convert(keys).astype(np.float64) for keys, _ in seen]
        shares, counts, errors, corners = [], [], [], []
        for first in range(len(grey) - STEP // every):
            second = first + STEP // every
            pairs = _matches(seen[first][1], seen[second][1], norm)
            here, there = places[first][pairs[:, 0]], places[second][pairs[:, 1]]
            truth = clip.between(first * every, second * every)
            distance = np.linalg.norm(plane_clips.moved(truth, here) - there, axis=1)
            is_right = distance < _NEAR
            shares.append(is_right.mean() if len(pairs) else 0.0)
            counts.append(is_right.sum())
            errors.append(distance[is_right])
            corners.append(_corner_error(here, there, truth, frames.shape[2], frames.shape[1]))
        found[f"{kind} inliers"] = float(np.mean(shares))
        found[f"{kind} right"] = float(np.mean(counts))
        for name, values in (("error", np.concatenate(errors)), ("corner", np.array(corners))):
            found[f"{kind} {name}"], found[f"{kind} {name} 95"] = _middle_and_high(values)
    return found


def _middle_and_high(values: Errors) -> tuple[float, float]:
    if not len(values):
        return _LOST, _LOST
    return float(np.median(values)), float(np.percentile(values, 95))


def _matches(first: Any, second: Any, norm: int) -> NDArray[np.int64]:
    """Rows of both, shape (N, 2): nearest to each other, and clearly nearer than the next one."""
    if first is None or second is None or min(len(first), len(second)) < 2:
        return np.zeros((0, 2), np.int64)
    matcher = cv2.BFMatcher(norm)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(second, first)}
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, next_best in matcher.knnMatch(first, second, k=2)
        if best.distance < _RATIO * next_best.distance and back[best.trainIdx] == best.queryIdx
    ]
    return np.array(pairs, np.int64).reshape(-1, 2)


def _corner_error(here: Errors, there: Errors, truth: Errors, width: int, height: int) -> float:
    if len(here) < 4:
        return _LOST
    cv2.setRNGSeed(0)
    matrix, _ = cv2.findHomography(here, there, cv2.USAC_MAGSAC, _NEAR, maxIters=5000)
    if matrix is None:
        return _LOST
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)
    apart = plane_clips.moved(matrix, corners) - plane_clips.moved(truth, corners)
    return min(_LOST, float(np.linalg.norm(apart, axis=1).mean()))


def tags(frames: Frames, clip: plane_clips.PlaneClip) -> dict[str, float]:
    """AprilTags against the truth."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.relativeCornerRefinmentWinSize = 1.0
    dictionary = cv2.aruco.getPredefinedDictionary(plane_clips.DICTIONARY)
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    errors: dict[int, list[Errors]] = {number: [] for number in clip.tags}
    for frame, pose in zip(frames, clip.poses, strict=True):
        corners, ids, _ = detector.detectMarkers(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY))
        for four, number in zip(corners, [] if ids is None else ids.ravel(), strict=True):
            if int(number) in clip.tags:
                true = plane_clips.moved(pose, clip.tags[int(number)])
                errors[int(number)].append(four.reshape(4, 2) - true)
    found = [np.stack(items) for items in errors.values() if items]
    values = {"tags found": sum(map(len, found)) / (len(frames) * len(clip.tags))}
    jitter = [item - item.mean(axis=0) for item in found]
    for name, vectors in (("error", found), ("jitter", jitter)):
        apart = np.linalg.norm(np.concatenate(vectors), axis=2) if vectors else np.zeros(0)
        values[f"tags {name}"], values[f"tags {name} 95"] = _middle_and_high(apart)
    return values


def psnr(frames: Frames, clean: Frames) -> float:
    """Of all values against what the camera would have seen without noise, dB."""
    errors = [
        np.mean((one.astype(float) - other) ** 2) for one, other in zip(frames, clean, strict=True)
    ]
    return float(10 * np.log10(255**2 / np.mean(errors)))


def measured(clip: plane_clips.PlaneClip, way: Way, every: int) -> Measured:
    """One way on one clip."""
    with tempfile.TemporaryDirectory() as folder:
        frames, size = kept(clip.frames, way, Path(folder))
    found = features(frames, clip, every) if not clip.tags else tags(frames, clip)
    return Measured(size, {**found, "PSNR": psnr(frames, clip.clean)})


# ---------------------------------------------------------------- reporting

Results = dict[str, dict[str, Measured]]  # way -> clip


def mean(by_clip: Sequence[Measured], name: str) -> float:
    """Mean over the clips that have such a value."""
    values = [item.values[name] for item in by_clip if name in item.values]
    return float(np.mean(values)) if values else float("nan")


def gained(results: Results, family: str, name: str, known: dict[str, Way], noise: str) -> float:
    """What a family's values are more than plain AV1's at equal size, mean of a noise's clips.

    The sizes are those that both reach, evenly by their logarithm; between the points of a curve
    values are interpolated.
    """
    plain = [results[n] for n, way in known.items() if way.family == PLAIN and n in results]
    other = [results[n] for n, way in known.items() if way.family == family and n in results]
    gains = []
    for clip in plain[0] if plain else ():
        if not clip.endswith(noise) or name not in plain[0][clip].values:
            continue
        ours, theirs = (
            _curve([point[clip] for point in points], name) for points in (other, plain)
        )
        low, high = max(ours[0].min(), theirs[0].min()), min(ours[0].max(), theirs[0].max())
        if high > low:
            at = np.linspace(low, high, 50)
            gains.append(np.mean(np.interp(at, *ours) - np.interp(at, *theirs)))
    return float(np.mean(gains)) if gains else float("nan")


def _curve(points: Sequence[Measured], name: str) -> Errors:
    return np.array(sorted((np.log(point.size), point.values[name]) for point in points)).T


Cell = Callable[[Sequence[Measured]], str]


def _number(name: str, digits: int) -> Cell:
    return lambda items: f"{mean(items, name):.{digits}f}"


def _pair(name: str) -> Cell:
    return lambda items: f"{mean(items, name):.2f}, {mean(items, name + ' 95'):.2f}"


def _share(name: str) -> Cell:
    return lambda items: f"{100 * mean(items, name):.1f}"


_COLUMNS: dict[str, Cell] = {
    "PSNR": _number("PSNR", 2),
    "ORB inliers, %": _share("ORB inliers"),
    "right": _number("ORB right", 0),
    "error": _pair("ORB error"),
    "corner": _pair("ORB corner"),
    "SIFT inliers, %": _share("SIFT inliers"),
    "right ": _number("SIFT right", 0),
    "error ": _pair("SIFT error"),
    "corner ": _pair("SIFT corner"),
    "tags found, %": _share("tags found"),
    "error  ": _pair("tags error"),
    "jitter": _pair("tags jitter"),
}


def report(results: Results, known: dict[str, Way]) -> None:
    """Print the tables."""
    clips_known = list(next(iter(results.values())))
    for noise in clips.SENSORS:
        chosen = [name for name in clips_known if name.endswith(noise)]
        if not chosen:
            continue
        print(f"\nNoise {noise}, {len(chosen)} clips:")
        base = results["JPEG 90"]
        rows = []
        for way, by_clip in results.items():
            items = [by_clip[name] for name in chosen]
            ratio = np.mean([base[name].size / by_clip[name].size for name in chosen])
            size = np.mean([item.size for item in items]) / 1000
            cells = [cell(items) for cell in _COLUMNS.values()]
            rows.append([way, f"{size:.1f}", f"{ratio:.1f}", *cells])
        print_table(["way", "kB a frame", "JPEG 90 / it", *map(str.strip, _COLUMNS)], rows)
    print("\nAgainst JPEG 90, clip by clip, what is better being positive:")
    rows = []
    for name in clips_known:
        ours, base_item = results["visual"][name], results["JPEG 90"][name]
        cells = [
            f"{sign * (ours.values[key] - base_item.values[key]):+.3f}"
            if key in ours.values
            else ""
            for key, sign in _COMPARED.items()
        ]
        rows.append([name, f"{base_item.size / ours.size:.1f}", *cells])
    print_table(["clip, visual", "JPEG 90 / it", *_COMPARED], rows)
    print("\nMore than plain AV1 of preset 6 at equal size:")
    rows = [
        [family, noise, *(f"{gained(results, family, n, known, noise):+.3f}" for n in _GAINED)]
        for noise in clips.SENSORS
        for family in dict.fromkeys(way.family for way in known.values() if way.family)
        if family != PLAIN and any(known[name].family == family for name in results)
        if any(name.endswith(noise) for name in clips_known)
    ]
    print_table(["tool", "noise", *_GAINED], rows)


_GAINED = (
    *("PSNR", "ORB inliers", "ORB right", "ORB error", "SIFT inliers", "SIFT right", "SIFT error"),
    "tags jitter",
)
_COMPARED = {
    "PSNR": 1,
    **{f"{kind} inliers": 1 for kind in ("ORB", "SIFT")},
    **{f"{kind} {what}": -1 for kind in ("ORB", "SIFT") for what in ("error", "error 95")},
    **{f"{kind} {what}": -1 for kind in ("ORB", "SIFT") for what in ("corner", "corner 95")},
    "tags found": 1,
    "tags error": -1,
    "tags jitter": -1,
    "tags jitter 95": -1,
}
"""What is compared with JPEG 90 -> whether more is better."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    known = ways()
    parser.add_argument("--frames", type=int, default=25)
    parser.add_argument(
        "--every", type=int, choices=(1, 2, 4), default=2, help="frames of which features are taken"
    )
    parser.add_argument("--size", type=parse_size, default=(640, 480), help="WxH")
    parser.add_argument("--way", nargs="+", choices=known, default=list(known), metavar="WAY")
    parser.add_argument("--clip", nargs="+", choices=plane_clips.MOTIONS)
    parser.add_argument("--noise", nargs="+", choices=clips.SENSORS, default=list(clips.SENSORS))
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path(tempfile.gettempdir()) / "mp4ds-features",
        help="what was measured stays here",
    )
    chosen = parser.parse_args()
    clips.check_data()
    cv2.setNumThreads(1)
    print_machine()
    print(f"- opencv {cv2.__version__}")
    width, height = chosen.size
    print(
        f"- {chosen.frames} frames of {width}x{height}, one of {chosen.every} used, "
        f"pairs {STEP} apart",
        flush=True,
    )
    chosen.folder.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(["JPEG 90", "visual", *chosen.way]))
    results: Results = {name: {} for name in known if name in names}
    for noise in chosen.noise:
        for scene in chosen.clip or plane_clips.MOTIONS:
            loaded = plane_clips.load(scene, noise, chosen.frames, chosen.size, chosen.folder)
            for name in results:
                key = f"{loaded.name}, {name}, {chosen.frames}, {width}x{height}, {chosen.every}"
                file = chosen.folder / f"{key.replace(', ', '-').replace(' ', '_')}.json"
                if not file.is_file():
                    found = measured(loaded, known[name], chosen.every)
                    file.write_text(json.dumps(asdict(found)))
                results[name][loaded.name] = Measured(**json.loads(file.read_text()))
    report(results, known)


if __name__ == "__main__":
    main()
