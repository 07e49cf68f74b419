"""Tasks as processes: what they tell, how they end, and that none outlives its engine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from mp4ds.packing.engine import ProcessEngine
from waiting import until

DONE = "print(json.dumps({'done': True, 'pid': os.getpid()}), flush=True)"
TASKS = {
    "quick": DONE,
    "talkative": f"[print(json.dumps({{'at': n}}), flush=True) for n in range(5)]; {DONE}",
    "noisy": f"print('not json'); print('x' * 3_000_000); sys.stderr.write('y' * 300_000); {DONE}",
    "error": "print(json.dumps({'error': ['SourceError', 'drive.bag: is damaged.']})); sys.exit(1)",
    "crash": "sys.stderr.write('first\\nlast words\\n'); sys.exit(3)",
    "quiet": "pass",
    "killed": "os.kill(os.getpid(), signal.SIGKILL)",
    "sleep": "print(json.dumps({'pid': os.getpid()}), flush=True); time.sleep(60)",
}
EXPECTED: dict[str, tuple[str, str] | None] = {
    "quick": None,
    "talkative": None,
    "noisy": None,
    "error": ("SourceError", "drive.bag: is damaged."),
    "crash": ("Failed", "its process exited with code 3: last words"),
    "quiet": ("Failed", "its process exited with code 0"),
    "killed": ("Killed", "its process was killed by SIGKILL, perhaps for lack of memory"),
}


def command(task: tuple[str, ...]) -> list[str]:
    imports = "import json, os, signal, sys, time"
    if task[0] == "once":  # killed at the first try only
        marker = task[1]
        code = (
            f"p = {marker!r}\nif not os.path.exists(p):\n open(p, 'w').close()\n "
            f"os.kill(os.getpid(), signal.SIGKILL)\n{DONE}"
        )
        return [sys.executable, "-c", f"{imports}\n{code}"]
    return [sys.executable, "-c", f"{imports}\n{TASKS[task[0]]}"]


def ignore(_: tuple[str, ...], __: dict[str, Any]) -> None:
    return None


@pytest.mark.parametrize("slots", [1, 3])
def test_every_task_has_its_outcome(slots: int) -> None:
    told: list[tuple[str, Any]] = []
    engine = ProcessEngine(command, slots)
    outcomes = engine.run(
        [(name,) for name in EXPECTED], lambda task, values: told.append((task[0], values))
    )
    assert {outcome.task[0]: outcome.error for outcome in outcomes} == EXPECTED
    assert [values["at"] for name, values in told if "at" in values] == [0, 1, 2, 3, 4]
    assert sum(name == "noisy" for name, _ in told) == 1


def test_no_more_than_so_many_run_at_a_time(tmp_path: Path) -> None:
    code = (
        "import os, sys, time, json, pathlib\n"
        "here = pathlib.Path(sys.argv[1]); mine = here / str(os.getpid()); mine.touch()\n"
        "there = lambda: len(list(here.iterdir()))\n"
        "met = here.with_name('met')\n"
        "while not met.exists() and there() < 2: time.sleep(0.01)\n"
        "met.touch(); time.sleep(0.1); seen = there(); mine.unlink()\n"
        "print(json.dumps({'done': True, 'seen': seen}))"
    )
    (here := tmp_path / "here").mkdir()
    engine = ProcessEngine(lambda _: [sys.executable, "-c", code, str(here)], 2)
    facts = [outcome.facts["seen"] for outcome in engine.run([(str(n),) for n in range(8)], ignore)]
    assert len(facts) == 8
    assert max(facts) == 2


def test_a_killed_task_is_tried_once_more(tmp_path: Path) -> None:
    (outcome,) = ProcessEngine(command, 1).run([("once", str(tmp_path / "mark"))], ignore)
    assert outcome.error is None


def test_a_process_that_is_ready_is_given_the_next_task() -> None:
    code = (
        "import json, os, sys\n"
        "def tasks():\n"
        " yield sys.argv[1:]\n"
        " for line in sys.stdin: yield json.loads(line)\n"
        "for task in tasks():\n"
        " told = {'done': True, 'ready': True, 'task': task, 'pid': os.getpid()}\n"
        " print(json.dumps(told), flush=True)"
    )
    engine = ProcessEngine(lambda task: [sys.executable, "-c", code, *task], 2)
    tasks = [(f"task {number}", "ü\n") for number in range(9)]
    outcomes = list(engine.run(tasks, ignore))
    assert sorted(outcome.task for outcome in outcomes) == tasks
    assert all(outcome.error is None for outcome in outcomes)
    assert all(tuple(outcome.facts["task"]) == outcome.task for outcome in outcomes)
    assert len({outcome.facts["pid"] for outcome in outcomes}) <= 2


@pytest.mark.parametrize("end", ["close", "exception"])
def test_what_still_runs_is_ended_with_the_engine(end: str) -> None:
    pids: list[int] = []

    def heard(_: tuple[str, ...], told: dict[str, Any]) -> None:
        pids.append(told["pid"])
        if end == "exception" and len(pids) == 2:
            raise RuntimeError("enough")

    outcomes = ProcessEngine(command, 2).run([("quick",), ("sleep",)], heard)
    if end == "exception":
        with pytest.raises(RuntimeError, match="enough"):
            list(outcomes)
    else:
        outcome = next(outcomes)
        assert (outcome.task, outcome.error) == (("quick",), None)
        getattr(outcomes, "close")()  # noqa: B009 - a generator, by its protocol an iterator
    assert not any(map(is_alive, pids))


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_worker_ends_when_its_coordinator_is_killed(tmp_path: Path) -> None:
    """It waits for nobody: its standard input is closed then."""
    worker = (
        "import os, time\n"
        "from mp4ds.packing.engine import serve, tell\n"
        "serve(lambda: (tell({'pid': os.getpid()}), time.sleep(60)))"
    )
    coordinator = (
        "import sys\nfrom mp4ds.packing.engine import ProcessEngine\n"
        f"engine = ProcessEngine(lambda _: [sys.executable, '-c', {worker!r}], 1)\n"
        "list(engine.run([('x',)], lambda _, told: print(told['pid'], flush=True)))"
    )
    with subprocess.Popen([sys.executable, "-c", coordinator], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
        process.wait()
        until(lambda: not is_alive(pid))
