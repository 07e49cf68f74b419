"""Tests that go through many cases, try all of them, and name those that fail."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import pytest

Test = Callable[..., None]
Names = Sequence[str] | Callable[[Any], object]

LONGEST = 80
"""Characters of a value that names its case: a list of what failed is for people."""

_CASES = "cases"
_TOLD = 5
_FRESH: dict[int, Callable[..., Any]] = {}  # by the identity of the fixture


def each(
    names: str | Sequence[str],
    rows: Iterable[Any],
    *,
    ids: Names | None = None,
    one_in: int = 1,
    parts: int = 1,
) -> Callable[[Test], Test]:
    """What `pytest.mark.parametrize` does, within one test; several of them multiply.

    Each case has an empty `tmp_path`, and what it changes by `monkeypatch` is put back after it;
    it has its own of the fixtures that are `fresh`, too, and shares all others. Cases with the mark
    ``slow`` make up a test of their own, which has it. ``pytest --case TEXT`` takes only the cases
    with the text in their names.

    Args:
        names: Arguments of the test, as `pytest.mark.parametrize` has them.
        rows: Their values; also `pytest.param`.
        ids: Names of values, instead of their own.
        one_in: Of so many cases one is quick, at another place in each row; the others are slow.
        parts: Into how many tests the cases are divided, so that processes share them.
    """
    arguments = [n.strip() for n in names.split(",")] if isinstance(names, str) else [*names]
    axis = [_case(arguments, row, number, ids) for number, row in enumerate(rows)]

    def decorate(test: Test) -> Test:
        inner, axes, before = getattr(test, "each", (test, [], (1, 1)))
        made = _test(inner, [axis, *axes], (max(one_in, before[0]), max(parts, before[1])))
        marks = [m for m in getattr(test, "pytestmark", []) if m.args[:1] != (_CASES,)]
        made.pytestmark = [*marks, *made.pytestmark]  # type: ignore[attr-defined]
        return made

    return decorate


def fresh(make: Callable[..., Any]) -> Any:
    """A fixture of its module's tests that `each` makes for every case."""
    fixture = pytest.fixture(make)
    _FRESH[id(fixture)] = make
    return fixture


def _maker(name: str, test: Test) -> Callable[..., Any] | None:
    """How a fresh fixture is made that a test's module has."""
    return _FRESH.get(id(test.__globals__.get(name)))


@dataclass(frozen=True)
class _Case:
    """Values of the arguments, how it is called, and whether it waits for ``-m slow``."""

    values: dict[str, Any]
    name: str
    is_slow: bool


def _case(arguments: list[str], row: Any, number: int, ids: Names | None) -> _Case:
    name, is_slow = None, False
    if hasattr(row, "marks"):  # of pytest.param
        name, is_slow = row.id, any(mark.name == "slow" for mark in row.marks)
        row = row.values if len(arguments) > 1 else row.values[0]
    values = dict(zip(arguments, row if len(arguments) > 1 else [row], strict=True))
    if ids and not callable(ids):
        name = ids[number]
    said = (_said(value, f"{key}{number}", ids) for key, value in values.items())
    return _Case(values, name or "-".join(said), is_slow)


def _said(value: Any, otherwise: str, ids: Names | None) -> str:
    told = ids(value) if callable(ids) else None
    if told is not None:
        return str(told)
    if isinstance(value, (str, int, float, bytes)) or value is None:
        text = " ".join(str(value).split())
        return text if len(text) <= LONGEST and text.isprintable() else otherwise
    return str(getattr(value, "__name__", otherwise))


def _test(inner: Test, axes: list[list[_Case]], share: tuple[int, int]) -> Test:
    """The test as pytest is to see it."""
    given = [name for axis in axes for name in axis[0].values] if all(axes) else []
    fixtures = {name: None for name in _needs(inner, inner) if name not in given}
    shared = {name: None for name in fixtures if not _maker(name, inner)}

    def run(**values: Any) -> None:
        cases, text = values.pop(_CASES), values["request"].config.getoption("--case")
        _run(inner, cases, text, {name: values[name] for name in shared})

    for name in ("__name__", "__qualname__", "__module__", "__doc__"):
        setattr(run, name, getattr(inner, name))
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    wanted = [inspect.Parameter(name, kind) for name in {_CASES: None, **shared, "request": None}]
    run.__signature__ = inspect.Signature(wanted)  # type: ignore[attr-defined]
    run.each = inner, axes, share  # type: ignore[attr-defined]
    return pytest.mark.parametrize(_CASES, [*_divided(axes, *share)])(run)


def _needs(function: Callable[..., Any], test: Test) -> Iterator[str]:
    """Arguments of a function, and those of the fresh fixtures among them."""
    for name in inspect.signature(function).parameters:
        yield name
        if make := _maker(name, test):
            yield from _needs(make, test)


def _divided(axes: list[list[_Case]], one_in: int, parts: int) -> Iterator[Any]:
    cases = [
        _Case(
            {name: value for case in row for name, value in case.values.items()},
            "-".join(case.name for case in row),
            any(case.is_slow for case in row) or (number + number // one_in) % one_in > 0,
        )
        for number, row in enumerate(product(*axes))
    ]
    for is_slow in (False, True):
        chosen = [case for case in cases if case.is_slow == is_slow]
        count = min(parts, len(chosen))
        for number in range(count):
            place = f"part{number + 1}" if count > 1 else ""
            name = "-".join(filter(None, ["slow" if is_slow else "", place])) or "all"
            marks = [pytest.mark.slow] if is_slow else []
            yield pytest.param(chosen[number::count], marks=marks, id=name)


def _run(test: Test, cases: list[_Case], text: str, shared: dict[str, Any]) -> None:
    failed: list[tuple[str, BaseException]] = []
    skipped: list[str] = []
    tried = [(number, case) for number, case in enumerate(cases) if text in case.name]
    for number, case in tried:
        try:
            with _own(test, shared, number) as own:
                wanted = inspect.signature(test).parameters.keys() - case.values.keys()
                test(**{name: own(name) for name in wanted}, **case.values)
        except pytest.skip.Exception as reason:
            skipped.append(str(reason))
        except (Exception, pytest.fail.Exception) as error:
            failed.append((case.name, error))
    if failed:
        pytest.fail(_told(failed, len(tried)), pytrace=False)
    if len(skipped) == len(tried):
        pytest.skip(skipped[0] if skipped else f"no case has {text!r} in its name")


@contextmanager
def _own(test: Test, shared: dict[str, Any], number: int) -> Iterator[Callable[[str], Any]]:
    """The fixtures of a case."""
    found = dict(shared)
    if "tmp_path" in found:
        found["tmp_path"] = Path(found["tmp_path"]) / f"case{number}"
        found["tmp_path"].mkdir()
    with ExitStack() as stack:
        if "monkeypatch" in found:
            found["monkeypatch"] = stack.enter_context(found["monkeypatch"].context())

        def get(name: str) -> Any:
            if name not in found:
                make = _maker(name, test)
                assert make
                values = {needed: get(needed) for needed in inspect.signature(make).parameters}
                if inspect.isgeneratorfunction(make):
                    found[name] = stack.enter_context(contextmanager(make)(**values))
                else:
                    found[name] = make(**values)
            return found[name]

        yield get


def _told(failed: list[tuple[str, BaseException]], count: int) -> str:
    lines = [f"{len(failed)} of {count} cases fail: {', '.join(name for name, _ in failed)}"]
    for name, error in failed[:_TOLD]:
        found = pytest.ExceptionInfo.from_exception(error).getrepr(style="short")
        lines += ["", f"---- {name}", str(found)]
    if len(failed) > _TOLD:
        lines += ["", f"---- and {len(failed) - _TOLD} more"]
    return "\n".join(lines)
