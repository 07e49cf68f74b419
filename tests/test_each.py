"""Tests that go through many cases: all are tried, and those that fail are named."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from each import each, fresh


def marks(test: Any) -> list[Any]:
    """The cases of a test and of its slow part, as pytest is given them."""
    (mark,) = (mark for mark in test.pytestmark if mark.name == "parametrize")
    return [*mark.args[1]]


def run(test: Any, request: pytest.FixtureRequest, part: int = 0, **given: Any) -> None:
    mark = next(mark for mark in test.pytestmark if mark.name == "parametrize")
    test(**{mark.args[0]: marks(test)[part].values[0]}, request=request, **given)


def test_all_cases_are_tried_and_all_that_fail_are_named(request: pytest.FixtureRequest) -> None:
    seen = []

    @each("size", [1, 2])
    @each(("name", "is_bad"), [("a", False), ("b", True)])
    def test(size: int, name: str, is_bad: bool) -> None:
        seen.append((size, name))
        assert not is_bad, f"{name} is bad"

    with pytest.raises(pytest.fail.Exception) as caught:
        run(test, request)
    assert seen == [(1, "a"), (1, "b"), (2, "a"), (2, "b")]
    text = str(caught.value)
    assert text.startswith("2 of 4 cases fail: 1-b-True, 2-b-True\n")
    assert text.count("AssertionError: b is bad") == 2


def test_names_of_cases_are_short(request: pytest.FixtureRequest) -> None:
    @each("text", ["short", "[" * 100_000, "a:\n  b\n", "\0", b"bytes"])
    def test(text: str | bytes) -> None:
        raise AssertionError

    with pytest.raises(pytest.fail.Exception) as caught:
        run(test, request)
    first, _ = str(caught.value).split("\n", 1)
    assert first == "5 of 5 cases fail: short, text1, a: b, text3, b'bytes'"


@pytest.mark.parametrize("text", ["[" * 100_000, "short", "]" * 100_000])
def test_names_of_tests_are_short(text: str, request: pytest.FixtureRequest) -> None:
    name = request.node.callspec.id
    assert name == text if text == "short" else name in ("text0", "text1"), name[:80]


def test_cases_share_nothing_that_they_change(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {"changed": 0}

    @each("name", "abc")
    def test(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        assert not [*tmp_path.iterdir()]
        assert values["changed"] == 0
        (tmp_path / name).touch()
        monkeypatch.setitem(values, "changed", 1)

    run(test, request, tmp_path=tmp_path, monkeypatch=monkeypatch)
    assert len([*tmp_path.glob("*/*")]) == 3


def test_slow_cases_and_parts_are_tests_of_their_own(request: pytest.FixtureRequest) -> None:
    seen = []

    @each("n", [*range(5), pytest.param(9, marks=pytest.mark.slow)], parts=2)
    @pytest.mark.browser
    def test(n: int) -> None:
        seen.append(n)

    assert [param.id for param in marks(test)] == ["part1", "part2", "slow"]
    assert [[m.name for m in param.marks] for param in marks(test)] == [[], [], ["slow"]]
    assert [mark.name for mark in test.pytestmark] == ["browser", "parametrize"]
    for part in range(3):
        run(test, request, part)
    assert seen == [0, 2, 4, 1, 3, 9]


def test_one_case_in_several_is_quick(request: pytest.FixtureRequest) -> None:
    seen = []

    @each("name", "abc", one_in=3)
    @each("n", range(3))
    def test(name: str, n: int) -> None:
        seen.append((name, n))

    run(test, request)
    assert seen == [("a", 0), ("b", 2), ("c", 1)]
    run(test, request, 1)
    assert len(set(seen)) == len(seen) == 9


def test_what_is_skipped_in_every_case_is_skipped(request: pytest.FixtureRequest) -> None:
    @each("n", [1, 2])
    def test(n: int, least: int) -> None:
        if n < least:
            pytest.skip("too small")

    run(test, request, least=2)
    with pytest.raises(pytest.skip.Exception, match="too small"):
        run(test, request, least=3)


@each("number", range(3), ids=lambda number: f"case of {number}")
def test_it_is_a_test_of_pytest(number: int, tmp_path: Path) -> None:
    assert tmp_path.name == f"case{number}"


@fresh
def folder(tmp_path: Path) -> Path:
    (tmp_path / "folder").mkdir()
    return tmp_path / "folder"


@fresh
def file(folder: Path) -> Iterator[Path]:
    (folder / "file").touch()
    yield folder / "file"
    assert not (folder / "file").exists()


@each("number", range(3))
def test_fresh_fixtures_are_made_for_each_case(number: int, file: Path, folder: Path) -> None:
    assert file.parent == folder
    assert folder.parent.name == f"case{number}"
    file.unlink()


def test_they_are_fixtures(file: Path, tmp_path: Path) -> None:
    assert file.is_relative_to(tmp_path)
    file.unlink()
