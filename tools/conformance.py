"""Make the conformance suite, or compare it with what this mp4ds reads.

    python tools/conformance.py            make conformance/cases anew
    python tools/conformance.py --check    decode every case, fail where it is not as expected

Recordings, sidecars and edits are the same each time; videos may differ by the versions of the
encoders, so that a check compares what is decoded and makes nothing.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import xxhash

from conformance_broken import broken
from conformance_dump import as_json, conformance_dump
from conformance_files import REFUSED_BY_READERS, VALID, Document, part_of
from conformance_invalid import INVALID
from conformance_recordings import RECORDINGS, ROOT, chosen_layouts, recording_of
from mp4ds import yamlio
from mp4ds.dataset.stream import Stream
from mp4ds.format.fields import FORMAT_VERSION
from mp4ds.format.sidecars import MANIFEST_NAME
from mp4ds.packing.options import PackOptions
from mp4ds.packing.pack import pack

CASES = ROOT / "conformance" / "cases"
LIST = "cases.json"
MOST_BYTES = 2_000_000
Case = dict[str, Any]


def dump(path: Path) -> Case:
    """What this mp4ds says of a file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of newer minor versions
        return json.loads(as_json(conformance_dump(path)))  # type: ignore[no-any-return]


# ---------------------------------------------------------------- make


def make(folder: Path) -> list[Case]:
    """Make all cases in a new folder, and list them."""
    cases = [*_datasets(folder), *_files(folder), *_broken(folder)]
    (folder / LIST).write_text(as_json({"format": FORMAT_VERSION, "cases": cases}) + "\n")
    return cases


def _pack(name: str, target: Path) -> None:
    recording = RECORDINGS[name] if name in RECORDINGS else recording_of(name)
    with tempfile.TemporaryDirectory() as place, chosen_layouts(recording.wanted):
        whole = Path(place) / "whole" if recording.part is not None else target
        pack(recording.write(Path(place)), whole, PackOptions(**recording.options))
        if recording.part is not None:
            pack(whole, target, PackOptions(**recording.part))


def _case(
    folder: Path, path: Path, shows: str, *, codes: tuple[str, ...] = (), part: str = ""
) -> Case:
    """A case, with what is expected of it written beside or into it.

    Raises:
        ValueError: This mp4ds finds other problems than the case is there for.
    """
    found = dump(path)
    if sorted(problem["code"] for problem in found["problems"]) != sorted(codes):
        raise ValueError(f"{path}: {codes} expected, found {found['problems']}")
    name = path.relative_to(folder).as_posix()
    part = part or (part_of(codes) if codes else "")
    case: Case = {"path": name, "shows": shows, "part": part or "files"}
    if codes:
        refused = bool(REFUSED_BY_READERS & set(codes))
        return case | {"problems": found["problems"], "reader_refuses": refused}
    expected = path / "expected.json" if path.is_dir() else path.with_suffix(".json")
    expected.write_text(as_json(found) + "\n")
    return case | {"expected": expected.relative_to(folder).as_posix()}


def _datasets(folder: Path) -> Iterator[Case]:
    (folder / "datasets").mkdir(parents=True)
    for name, recording in RECORDINGS.items():
        _pack(name, folder / "datasets" / name)
        yield _case(folder, folder / "datasets" / name, recording.shows)


def _files(folder: Path) -> Iterator[Case]:
    with tempfile.TemporaryDirectory() as place:
        documents, videos = _bases(Path(place))
    for kind, listed in (("valid", VALID), ("invalid", INVALID)):
        target = folder / "sidecars" / kind
        target.mkdir(parents=True)
        for name, data in videos.items():
            (target / name).write_bytes(data)
        for name, case in listed.items():
            path = target / f"{name}.yaml"
            path.write_bytes(case.data(documents))
            if not case.code:
                _renew_digests(path, case.write)
            yield _case(
                folder, path, case.shows, codes=(case.code,) if case.code else (), part=case.part
            )


def _bases(place: Path) -> tuple[dict[str, Document], dict[str, bytes]]:
    """The good documents that cases are edits of, and the videos of all."""
    documents, videos = {}, {"not-a-video.mp4": b"no video\n"}
    for name in ("gray", "h264"):
        _pack(name, place / name)
        (video,) = (place / name).glob("*.mp4")
        document = yamlio.load(video.with_suffix(".yaml").read_bytes(), name)
        document["video"]["file"] = f"{name}.mp4"
        for part in (document, document.get("camera_info")):
            if part:  # short files: a definition is kept, and needed by no wire of ROS
                part["channel"]["schema"]["text"] = "uint8[] data\n"
        documents[name] = document
        videos[f"{name}.mp4"] = video.read_bytes()
    documents["manifest"] = yamlio.load((place / "gray" / MANIFEST_NAME).read_bytes(), "")
    old = ROOT / "tests" / "fixtures" / "v0" / "drive.yaml"
    documents["version-0"] = yamlio.load(old.read_bytes(), "")
    videos["version-0.mp4"] = old.with_suffix(".mp4").read_bytes()
    return documents, videos


def _renew_digests(path: Path, write: Any) -> None:
    """Digests of the messages that an edited sidecar makes."""
    document = yamlio.load(path.read_bytes(), str(path))
    if "digests" not in document:
        return
    draft = path.with_name("draft.yaml")
    unproven = {key: value for key, value in document.items() if key != "digests"}
    draft.write_bytes(yamlio.dump(unproven | {"profile": "crf=1"}))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        payloads = list(Stream(draft).payloads())
    draft.unlink()
    values = " ".join(xxhash.xxh64_hexdigest(payload) for payload in payloads)
    document["digests"]["values"] = f"{values}\n"
    path.write_bytes(write(document))


def _broken(folder: Path) -> Iterator[Case]:
    with tempfile.TemporaryDirectory() as place:
        good = Path(place) / "good"
        _pack("changing", good)
        for name, case in broken(good).items():
            target = folder / "broken" / name
            shutil.copytree(good, target)
            document = yamlio.load((good / MANIFEST_NAME).read_bytes(), "")
            case.edit(document)
            (target / MANIFEST_NAME).write_bytes(case.write(document))
            for file, data in case.files.items():
                if data is None:
                    (target / file).unlink()
                else:
                    (target / file).write_bytes(data)
            yield _case(folder, target, case.shows, codes=case.codes)


# ---------------------------------------------------------------- check


def check(folder: Path = CASES) -> list[str]:
    """Where this mp4ds reads another thing than is expected; names of cases with what is wrong."""
    listed = json.loads((folder / LIST).read_text())
    wrong = []
    if listed["format"] != FORMAT_VERSION:
        wrong.append(f"{LIST} is of format {listed['format']}")
    for case in listed["cases"]:
        found = dump(folder / case["path"])
        if "expected" in case:
            due = json.loads((folder / case["expected"]).read_text())
        else:
            due = {"problems": case["problems"]}
        if found != due:
            keys = [key for key in {**due, **found} if due.get(key) != found.get(key)]
            wrong.append(f"{case['path']}: {', '.join(keys)}")
    return wrong


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true")
    if parser.parse_args().check:
        wrong = check()
        for line in wrong:
            print(line)
        return 1 if wrong else 0
    with tempfile.TemporaryDirectory() as place:
        made = Path(place) / "cases"
        cases = make(made)
        size = sum(path.stat().st_size for path in made.rglob("*") if path.is_file())
        if size > MOST_BYTES:
            print(f"the suite would have {size} bytes", file=sys.stderr)
            return 1
        shutil.rmtree(CASES, ignore_errors=True)
        shutil.copytree(made, CASES)
    print(f"{CASES}: {len(cases)} cases, {size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
