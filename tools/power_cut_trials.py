"""Try what is left after power cuts: record, pack and unpack, each cut off thousands of times.

    python tools/power_cut_trials.py FOLDER --states 10000

runs each of `TRIALS` once, with its log (`power_cuts.py`), and judges so many different states of
the disk by what a user would do: recover the recording, or give the command again. Nothing that
arrived two seconds before the cut may be lost, no message differ from what was sent, no output have
its name before it is whole and exact, no other file change. FOLDER keeps logs and verdicts: the
same command goes on where it was ended. Litter are hidden files of a run that stay for good.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import pickle
import re
import shutil
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import mp4ds
from coded_scenes import CODED
from commands import call, tree
from compare import compare
from in_parts import InlineExecutor, facts
from mp4ds.packing import pack as packing
from mp4ds.plugins.recording.spool import Split
from power_cuts import Disk, State, run_logged, snapshot
from record_scenes import PlayedNode, played
from scenes import Scene, scene
from sources import SOURCES

_S = 10**9
_PROMISED = 2 * _S
_SLOWER = 6
_KEEP, _THEN, _NEAR = 4 * _S, 1 * _S, _S // 2
_CUT_OFF = re.compile(r"root/\.drive\S*\.(mp4ds-part|[a-z0-9_]{8}(\.part)?)(/.*)?")
_MADE = re.compile(r"root/drive[-_0-9]*(\.mcap)?(/.*)?")
_MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None


@dataclass(frozen=True)
class Trial:
    """A command that is cut off.

    Args:
        source: Kind of the recording it starts with.
        of: What that holds.
        words: The command, with files by their names; of a recorder, what is special.
    """

    source: str
    of: Callable[[], Scene]
    words: tuple[str, ...]

    def prepare(self, folder: Path) -> None:
        """Run it once, logged."""
        shutil.rmtree(folder, ignore_errors=True)
        root = folder / "root"
        (root / "photos").mkdir(parents=True)
        (root / "photos" / "cat.jpg").write_bytes(b"mine" * 300)
        source, *_ = SOURCES[self.source](folder / "source", replace(self.of(), silent={}))
        if self.words[0] == "unpack":
            mp4ds.pack(source, folder / "dataset")
        if "--force" in self.words:
            mp4ds.pack(source, root / "drive", mp4ds.PackOptions(quality="visual"))
        before = snapshot(root)
        shutil.copytree(root, folder / "before")
        words = [__file__, folder, "--play", source, *self.words]
        if self.words[0] != "record":
            words = ["-m", "mp4ds", *self.command(folder, root)]
        run_logged([sys.executable, *words], root, folder / "log")
        with (folder / "disk.pickle").open("wb") as file:
            pickle.dump(Disk(root, folder / "log", before), file)

    def command(self, folder: Path, root: Path) -> list[object]:
        """The command for a folder."""
        places = {"SOURCE": next((folder / "source").iterdir()), "DATASET": folder / "dataset"}
        return [places.get(one, root / one if "drive" in one else one) for one in self.words]


class Judge:
    """Judges states of a trial, by what was sent, or by what a run makes that nothing disturbs."""

    def __init__(self, trial: Trial, folder: Path) -> None:
        self._trial, self._folder = trial, folder
        self._source = next((folder / "source").iterdir())
        self._exact: dict[str, str] = {}
        sent = folder / "sent.pickle"
        self._sent, self._triggers, self._end = (
            pickle.loads(sent.read_bytes()) if sent.exists() else ([], [], 0)
        )

    def judge(self, state: State) -> dict[str, Any]:
        """What becomes of a state: what is wrong, which messages are lost, and what was done."""
        with tempfile.TemporaryDirectory(prefix="cuts-", dir=_MEMORY) as place:
            root = Path(place) / "root"
            root.mkdir()
            state.write(root)
            for plan in root.glob(".*/plan.json"):  # which is in another folder now
                values = {**json.loads(plan.read_bytes()), "inode": plan.parent.stat().st_ino}
                plan.write_text(json.dumps(values, indent=1))
            before = tree(Path(place))
            try:
                does = self._recovers if self._trial.words[0] == "record" else self._goes_on
                outcome, problem, lost = does(root)
            except Exception:
                outcome, problem, lost = "", traceback.format_exc(limit=-3), 0
            after = tree(Path(place))
        others = {
            name
            for name in {*before, *after}
            if before.get(name) != after.get(name)
            and not (_MADE.fullmatch(name) and (name not in before or outcome == "replaced"))
            and not (_CUT_OFF.fullmatch(name) and name not in after)
        }
        if others:
            problem += f" changed: {sorted(others)[:5]}"
        litter = any(map(_CUT_OFF.fullmatch, after))
        return {"outcome": outcome, "problem": problem, "lost": f"{lost:x}", "litter": litter}

    def oldest(self, lost: int, cut: int) -> int:
        """How old, ns, the oldest message is that is lost at a cut, and should not be."""
        spans = [(0, cut)]
        if "back" in self._trial.words:
            spans = [(cut - _KEEP + _NEAR, cut)] if cut < self._end else []
            before = (one for one in self._triggers if one < cut - _PROMISED)
            spans += [(one - _KEEP + _NEAR, one + _THEN - _NEAR) for one in before]
        times = (one[0] for number, one in enumerate(self._sent) if lost >> number & 1)
        due = (one for one in times if any(start <= one < end for start, end in spans))
        return cut - min(due, default=cut)

    def _recovers(self, root: Path) -> tuple[str, str, int]:
        outcome, found = "", Counter[Any]()
        for folder in sorted(root.glob("drive*.recording")):
            target = folder.with_suffix("")
            result = call("pack", "--salvage", folder, "-o", target)
            if target.exists() and result.code == 0:
                outcome += "recovered "
            else:
                outcome += re.sub(r"\S*/", "", result.err)
                if not re.fullmatch(r"mp4ds: [^\n]+\n", result.err):
                    return outcome, f"is not told in a sentence: {result}", 0
        for dataset in root.iterdir():
            if _MADE.fullmatch(f"root/{dataset.name}"):
                found |= self._messages(dataset)
        due = Counter(one[1:] for one in self._sent)
        problem = f"holds what was not sent: {[*(found - due)][:3]}" if found - due else ""
        missing = due - found
        lost = sum(1 << n for n, one in enumerate(self._sent) if one[1:] in missing)
        return outcome or "complete", problem, lost

    def _messages(self, dataset: Path) -> Counter[Any]:
        with tempfile.TemporaryDirectory() as folder:
            mp4ds.unpack(dataset, "mcap", Path(folder) / "it.mcap")
            with (Path(folder) / "it.mcap").open("rb") as file:
                return Counter(
                    (channel.topic, one.log_time, hashlib.sha256(one.data).hexdigest())
                    for _, channel, one in make_reader(file).iter_messages()
                )

    def _goes_on(self, root: Path) -> tuple[str, str, int]:
        words = self._trial.command(self._folder, root)
        output = next(one for one in words if isinstance(one, Path) and one.parent == root)
        is_new = output.exists()
        if is_forced := "--force" in words:
            is_new = tree(output) != tree(self._folder / "before" / "drive")
        problem = self._wrong(output) if is_new else ""
        result = call(*words)
        if is_new and not is_forced:
            is_told = result.code and re.fullmatch(r"mp4ds: .* exists[^\n]+\n", result.err)
            return "complete", problem if is_told else f"is not refused: {result}", 0
        problem += result.err if result.code else self._wrong(output)
        return "replaced" if is_forced else "made again", problem, 0

    def _wrong(self, output: Path) -> str:
        """What is wrong with an output; empty if nothing is."""
        files = tree(output) if output.is_dir() else output.read_bytes()
        key = hashlib.sha256(repr(files).encode()).hexdigest()
        if key not in self._exact:
            made = self._folder / "root" / output.name
            with tempfile.TemporaryDirectory() as folder:
                again, problems = output, []
                if self._trial.words[0] == "pack":
                    again = Path(folder) / f"again{self._source.suffix}"
                    mp4ds.unpack(output, None, again)
                    problems = [*map(str, mp4ds.validate(output, deep=True))]
                    problems += ["differs from an undisturbed one"] * (facts(made) != facts(output))
                self._exact[key] = "; ".join(problems + compare(self._source, again))
        return self._exact[key]


# ---------------------------------------------------------------- the trials


def _camera() -> Scene:
    return scene("bayer_rggb8", frames=85, width=32, height=24)


def _few() -> Scene:
    return scene("mono8", frames=12, width=32, height=24)


_PACK = "pack", "SOURCE", "-o", "drive"
_UNPACK = "unpack", "DATASET", "-o"
TRIALS = {
    "record": Trial("bag-none", _camera, ("record",)),
    "record-behind": Trial("bag-none", _camera, ("record", "behind")),
    "record-video": Trial("rosbag2-mcap-v5", lambda: CODED["video-h264"](frames=85), ("record",)),
    "record-back": Trial("bag-none", _camera, ("record", "back")),
    "pack": Trial("bag-none", _few, _PACK),
    "pack-force": Trial("mcap-ros2-zstd", _few, (*_PACK, "--force")),
    "pack-parts": Trial("bag-none", _few, (*_PACK, "--jobs", "2", "--window", "4")),
    "unpack-mcap": Trial("bag-none", _few, (*_UNPACK, "drive.mcap")),
    "unpack-rosbag2": Trial("rosbag2-mcap-v9", _few, (*_UNPACK, "drive")),
    "unpack-sqlite3": Trial("rosbag2-sqlite3-v9", _few, (*_UNPACK, "drive")),
}
_SHARES = dict(zip(TRIALS, (6, 5, 5, 1, 3, 3, 4, 3, 4, 5), strict=True))
"""Of the states, as more are to be told from each other, or cost less."""


def _play(folder: Path, source: Path, *special: str) -> None:
    """Record, slower than the recording, and note what arrives when.

    Args:
        folder: Of the trial.
        source: What is published.
        special: ``behind``: nothing is packed until after the end; ``back``: it looks back.
    """
    sent: list[tuple[int, str, int, str]] = []
    triggers: list[int] = []
    first: list[int] = []
    may_pack, pack = threading.Event(), Split._pack

    def pack_late(self: Split, *given: Any) -> None:
        may_pack.wait()
        pack(self, *given)

    def slower(message: Any, _: int) -> Any:
        first.append(message.log_time)
        message = replace(message, log_time=first[0] + _SLOWER * (message.log_time - first[0]))
        digest = hashlib.sha256(message.data).hexdigest()
        sent.append((time.monotonic_ns(), message.channel.topic, message.log_time, digest))
        return message

    def look_in(number: int) -> None:
        if number == 80:  # a user leaves a note
            with (
                (*(folder / "root").glob("*.recording"),)[0].joinpath("mine.txt").open("w") as file
            ):
                file.write("mine")
                file.flush()
                os.fsync(file.fileno())
        if "back" in special and number in (200, 400):
            recorder.snapshot()
            triggers.append(time.monotonic_ns())

    def stop() -> None:
        triggers.append(time.monotonic_ns())
        recorder.stop()
        threading.Timer(3.0, may_pack.set).start()

    node = PlayedNode([source], rate=1 / _SLOWER, before=look_in)
    node._altered = dict.fromkeys([one.topic for one in node._channels], slower)
    options = mp4ds.RecordOptions(all=True)
    if "behind" in special:
        Split._pack = pack_late  # type: ignore[method-assign]
    if "back" in special:
        options = replace(options, keep_last=_KEEP / _S, and_then=_THEN / _S)
    with played(node, (), folder / "root" / "drive", options) as recorder:
        node.stop = stop
        summary = recorder.run()
    if summary.dropped or summary.lost or len(sent) != recorder.received:
        raise SystemExit(f"not all was received: {summary}")
    (folder / "sent.pickle").write_bytes(pickle.dumps((sent, triggers[:-1], triggers[-1])))


# ---------------------------------------------------------------- all of them


def verdicts(
    name: str, folder: Path, states: int, seed: int = 0, share: tuple[int, int] = (0, 1)
) -> Iterator[dict[str, Any]]:
    """Judge so many different states of a trial, or a share of them; equal ones are judged once."""
    disk: Disk = pickle.loads((folder / "disk.pickle").read_bytes())
    judge = Judge(TRIALS[name], folder)
    kept = folder / f"verdicts-{share[0]}-{share[1]}.jsonl"
    lines = kept.read_text().splitlines() if kept.exists() else []
    known = {one["digest"]: one for one in map(json.loads, lines)}
    packing._executor = lambda *_: InlineExecutor()  # a process for each takes a second
    seen: set[str] = set()
    for number in range(200 * states):
        if len(seen) >= states:
            break
        state = disk.state(f"{name} {seed} {number}")
        is_first = state.digest not in seen
        seen.add(state.digest)
        if int(state.digest[:8], 16) % share[1] != share[0]:
            continue
        if state.digest not in known:
            known[state.digest] = {"digest": state.digest, **judge.judge(state)}
            with kept.open("a") as file:
                file.write(json.dumps(known[state.digest]) + "\n")
        verdict = known[state.digest]
        age = judge.oldest(int(verdict["lost"], 16), state.time)
        problem = verdict["problem"] + f" lost {age / _S:.2f} s" * (age > _PROMISED)
        told = {"number": number, "kind": f"{state.kind} {state.model}", "age": age / _S}
        yield {**verdict, **told, "problem": problem, "is_first": is_first}


def _judged(task: tuple[str, Path, int, int, tuple[int, int]]) -> list[dict[str, Any]]:
    if hasattr(os, "sched_setaffinity"):  # or threads of small encoders wait for each other
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[task[4][0] % len(cores)]})
    return [*verdicts(*task)]


def main() -> int:
    """Run the trials, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--states", type=int, default=10_000)
    parser.add_argument("--only", action="append", choices=TRIALS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--play", nargs="+", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.play:
        _play(given.folder, *map(Path, given.play[:1]), *given.play[1:])
        return 0
    whole, problems = Counter[str](), list[str]()
    shares = {name: _SHARES[name] for name in given.only or TRIALS}
    print("trial | states | failed | with litter | most lost, s | outcomes")
    for name, share in shares.items():
        folder = given.folder.absolute() / name
        if not (folder / "disk.pickle").exists():
            TRIALS[name].prepare(folder)
        states = -(-given.states * share // sum(shares.values()))
        tasks = [(name, folder, states, given.seed, (n, given.jobs)) for n in range(given.jobs)]
        with ProcessPoolExecutor(given.jobs, multiprocessing.get_context("spawn")) as pool:
            found = [one for part in pool.map(_judged, tasks) for one in part]
        bad = [one for one in found if one["problem"]]
        problems += [f"{name} {one['number']} ({one['kind']}): {one['problem']}" for one in bad]
        first = [one for one in found if one["is_first"]]
        whole.update(one["kind"] for one in first)
        litter, failed = sum(one["litter"] for one in first), len({one["digest"] for one in bad})
        outcomes = dict(Counter(one["outcome"] for one in first))
        age = max(one["age"] for one in found)
        print(f"{name} | {len(first)} | {failed} | {litter} | {age:.2f} | {outcomes}", flush=True)
    print(f"by kind and model, {whole.total()}: {dict(sorted(whole.items()))}", *problems, sep="\n")
    return bool(problems)


if __name__ == "__main__":
    sys.exit(main())
