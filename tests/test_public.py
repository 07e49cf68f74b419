"""The public surface: its names, their documentation and types, and what importing costs."""

from __future__ import annotations

import builtins
import dataclasses
import inspect
import re
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from commands import program
from mp4ds import errors
from mp4ds.plugins.demo import demo

NAMES = [
    "Box", "ConversionError", "Dataset", "EncoderRefusedError", "EvaluateOptions",
    "Evaluation", "ExportOptions", "ExportSummary", "FormatError", "Frame",
    "FrameNotFoundError", "ImportOptions", "Mp4dsError", "OptionError", "PackOptions",
    "PackSummary", "PartsFailedError", "PathError", "PlayOptions", "PlaySummary", "Problem",
    "RecordOptions", "RecordSummary", "RecordedMessage", "RemoteError", "ReportOptions",
    "ReportSummary", "SampleError", "ScoringError", "SourceError", "SourceNotFoundError",
    "Stream", "Sync", "TargetError", "TargetExistsError", "Topic", "UnpackOptions",
    "UnpackSummary", "VersionError", "VideoError", "WriteError", "__version__", "evaluate",
    "export", "import_ros_mp4", "open", "pack", "pack_each", "pack_share", "play", "record",
    "report", "unpack", "validate",
]  # fmt: skip


# ---------------------------------------------------------------- names


def test_these_are_the_names() -> None:
    """A change here is a change of what users rely on."""
    assert sorted(mp4ds.__all__) == NAMES
    assert dir(mp4ds) == mp4ds.__all__
    for name in NAMES:
        assert getattr(mp4ds, name) is not None


TREE = re.findall(r"(\w+Error)(?: \((\w+)\))?(?: +(?:exit code )?(\d))?", str(errors.__doc__))
"""Each error as it is drawn: its name, the builtin one that it is too, and its exit code."""


@pytest.mark.parametrize(("name", "builtin", "code"), TREE)
def test_errors_are_what_is_drawn(name: str, builtin: str, code: str) -> None:
    error = getattr(mp4ds, name)
    assert issubclass(error, getattr(builtins, builtin or "Exception"))
    assert not code or error.exit_code == int(code)


def test_every_error_is_public_and_drawn() -> None:
    found = {
        name
        for name, value in vars(errors).items()
        if isinstance(value, type) and issubclass(value, mp4ds.Mp4dsError)
    }
    assert found == {name for name, _, _ in TREE}
    assert found == {name for name in NAMES if name.endswith("Error")}


# ---------------------------------------------------------------- documentation


def members(value: Any) -> list[tuple[str, Any]]:
    """What a class defines itself for its users."""
    return [
        (name, member)
        for name, member in vars(value).items()
        if not name.startswith("_")
        and (callable(member) or isinstance(member, property) or hasattr(member, "func"))
    ]


@pytest.mark.parametrize("name", [name for name in NAMES if name != "__version__"])
def test_all_is_documented(name: str) -> None:
    value = getattr(mp4ds, name)
    text = inspect.getdoc(value)
    assert text
    assert text.splitlines()[0].rstrip("`").endswith("."), "a summary is a sentence"
    if isinstance(value, type):
        for member_name, member in members(value):
            assert inspect.getdoc(member), f"{name}.{member_name}"
    if dataclasses.is_dataclass(value):
        documented = set(re.findall(r"^ {4}(\w+): ", text, re.MULTILINE))
        assert {field.name for field in dataclasses.fields(value)} == documented
    elif callable(value) and not isinstance(value, type):
        for parameter in inspect.signature(value).parameters.values():
            known = f"{parameter.name}: " in text or name == "open"  # which refers to Dataset
            assert known, f"{name}({parameter.name})"


# ---------------------------------------------------------------- importing

HEAVY = ["numpy", "av", "pydantic", "yaml", "rosbags", "mcap", "jsonschema", "click", "rich"]


def test_importing_is_cheap() -> None:
    loaded = program("-c", "import mp4ds, sys; print(*sys.modules)").out.split()
    assert [name for name in HEAVY if name in loaded] == []


def test_a_short_pack_imports_what_its_recording_needs(tmp_path: Path) -> None:
    """A short pack is mostly imports: those of other formats, codecs and folders wait."""
    source, dataset = tmp_path / "short.bag", tmp_path / "dataset"
    demo(source, seconds=0.1)
    code = f"mp4ds.pack({str(source)!r}, {str(dataset)!r})"
    loaded = program("-c", f"import mp4ds, sys; {code}; print(*sys.modules)").out.split()
    assert (dataset / "dataset.yaml").is_file()
    assert {"mp4ds.bags.ros1", "mp4ds.packing.packer"} <= set(loaded)
    others = [
        *("click", "rich", "jsonschema", "google.protobuf", "sqlite3", "fsspec", "PIL"),
        *("rosbags.rosbag2", "mp4ds.bags.rosbag2", "mp4ds.bags.convert"),
        *("mp4ds.plugins.importing.images", "mp4ds.plugins.importing.ros_mp4"),
    ]
    assert [name for name in others if name in loaded] == []
