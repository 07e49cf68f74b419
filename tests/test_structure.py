"""The house: which module may import which, what is generated, and the examples of the spec."""

from __future__ import annotations

import ast
import hashlib
import json
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pydantic
import pytest

from commands import program
from generate import generate_schema
from mp4ds.format.fields import FORMAT_VERSION, document_of
from mp4ds.format.sidecars import MODELS, dump_document, load_manifest, load_stream

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "mp4ds"
MODULES = sorted(SOURCE.rglob("*.py"))
SPEC = ROOT / "spec"
KINDS = ("stream", "dataset")

MAX_LINES = 700
LONGER: dict[str, str] = {}
"""Modules that may be longer -> why."""


# ---------------------------------------------------------------- modules


def test_packages_import_downward_only() -> None:
    pytest.importorskip("importlinter")
    code = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    assert re.search(r"\b[1-9]\d* kept, 0 broken", program("-c", code, "--no-cache", cwd=ROOT).out)


def test_modules_are_short() -> None:
    for path in MODULES:
        lines = len(path.read_text().splitlines())
        name = str(path.relative_to(SOURCE))
        assert lines <= MAX_LINES or name in LONGER, f"{name} has {lines} lines"
        assert lines > MAX_LINES or name not in LONGER, f"{name} is no longer long: strike it"


def test_every_plugin_is_where_it_is_looked_for() -> None:
    texts = "".join(path.read_text() for path in MODULES)
    places = re.findall(r'plugin\(\s*"([\w.]+):(\w+)"', texts)
    assert len(places) > 3
    for module, name in places:
        text = (SOURCE / "plugins" / f"{module.replace('.', '/')}.py").read_text()
        assert re.search(rf"^(def|class) {name}\b", text, re.MULTILINE), f"{module}:{name}"


@cache  # each library looks into all modules
def imports_of(path: Path) -> frozenset[str]:
    """Top-level names of the packages that a module imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
    return frozenset(found)


# Each package is known to these rooms only: no other module may import it, a new one neither.
HOMES = {
    "rosbags": ("bags",),
    "mcap": ("bags",),
    "mcap_ros2": ("plugins/demo.py",),
    "zstandard": ("bags",),
    "lz4": ("bags",),
    "sqlite3": ("bags",),
    "av": ("video",),
    "PIL": ("video",),
    "fsspec": ("files",),
    "google": ("messages",),
    "torch": ("torch",),
    "click": ("cli",),
    "rich": ("cli",),
    "distributed": ("plugins/cluster.py",),
    "rospy": ("plugins/ros",),
    "rclpy": ("plugins/ros",),
    "cyclonedds": ("plugins/ros",),
    "pyarrow": ("plugins/exporting", "plugins/importing"),
    "yaml": ("yamlio.py", "bags", "plugins/ros"),
    "pydantic": (
        "format",
        "messages/encodings.py",
        "dataset/checks.py",
        "plugins/evaluating",
        "plugins/importing",
    ),
    "jsonschema": ("dataset/checks.py",),
}


@pytest.mark.parametrize("package", HOMES)
def test_each_library_is_imported_in_its_home_only(package: str) -> None:
    found = [path for path in MODULES if package in imports_of(path)]
    homes = [SOURCE / home for home in HOMES[package]]
    others = [path for path in found if not any(map(path.is_relative_to, homes))]
    assert not others, f"{others} may not import {package}"
    assert found, f"nobody imports {package}: strike it, and from pyproject.toml"


def test_architecture_names_every_package() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text()
    for path in [*SOURCE.iterdir(), *(SOURCE / "plugins").iterdir()]:
        if path.is_dir() and (path / "__init__.py").is_file():
            assert f"{path.name}/" in text, path.name
        elif path.suffix == ".py" and path.parent == SOURCE and path.stem != "__init__":
            assert path.name in text, path.name


# ---------------------------------------------------------------- generated and released


writes_schemas = pytest.mark.skipif(
    tuple(int(part) for part in pydantic.VERSION.split(".")[:2]) < (2, 11),
    reason="schemas are written by pydantic 2.11 or newer; older ones word them otherwise",
)


@writes_schemas
def test_generated_files_are_up_to_date() -> None:
    program(sys.executable, ROOT / "tools/generate.py", "--check")


def test_released_schemas_never_change() -> None:
    found = {
        path.relative_to(ROOT / "schemas").as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted((ROOT / "schemas").glob("v*/*"))
    }
    assert found == {
        "v1.0/dataset.schema.json": (
            "8f9128c4acd5ea3d026a65efc05e5d9a38e394ef3107f84f3fa8140d4b8bd5c4"
        ),
        "v1.0/stream.schema.json": (
            "d3657b43413049016135e3f08a43f50d956b6414dbf4fcddd7be7847df2c4ade"
        ),
        "v1.1/dataset.schema.json": (
            "ea4d66ff3ef33c17bb927390d261db84f3ea03fb69ad2dfba95a3f3186840cf1"
        ),
        "v1.1/stream.schema.json": (
            "e40fa5bf1664205580d2c322030e157a5791db9eb91d34c52c7b323fd57dd34d"
        ),
        "v2.0/dataset.schema.json": (
            "605255664c05ee65951be1d1830dc0355fefd02a3df3c970d9115fea5a1ff076"
        ),
        "v2.0/stream.schema.json": (
            "10ed344f6e3b0d609278387a9ce73138bddad59c17546d92f89e1ff83e16849b"
        ),
    }


@writes_schemas
@pytest.mark.parametrize("kind", KINDS)
def test_the_schema_of_an_unreleased_version_is_the_draft(kind: str) -> None:
    """From the release on it is frozen; the draft goes on under the next version."""
    draft = json.loads((ROOT / "schemas" / "draft" / f"{kind}.schema.json").read_text())
    assert draft == json.loads(generate_schema(kind))
    if draft["$id"] == f"urn:mp4ds:{FORMAT_VERSION}:{kind}":
        path = ROOT / "schemas" / f"v{FORMAT_VERSION}" / f"{kind}.schema.json"
        assert json.loads(path.read_text()) == draft


def test_every_field_is_in_a_table_of_the_spec() -> None:
    text = (SPEC / "index.md").read_text()
    tables = set(re.findall(r"<!-- fields: (\w+) -->", text))
    models = {name for model in MODELS.values() for name in model.model_json_schema()["$defs"]}
    assert tables == models | set(KINDS)


# ---------------------------------------------------------------- examples of the spec


def example(kind: str) -> str:
    text = (SPEC / "index.md").read_text()
    found = re.findall(rf"<!-- example: {kind} -->\n```yaml\n(.*?)```", text, re.DOTALL)
    assert len(found) == 1
    return str(found[0])


def test_the_examples_agree_and_decode(tmp_path: Path) -> None:
    for kind in KINDS:
        (tmp_path / f"{kind}.yaml").write_text(example(kind))
    stream = load_stream(tmp_path / "stream.yaml")
    manifest = load_manifest(tmp_path / "dataset.yaml")
    assert stream.mp4ds == manifest.mp4ds == FORMAT_VERSION
    entry = manifest.streams[0]
    assert (entry.topic, entry.sidecar) == (stream.channel.topic, "left_image_raw.yaml")
    assert [entry.video, entry.view] == [video.file for video in stream.videos]
    assert entry.frames == stream.frames
    listed = {file.name: (file.size, file.sha256) for file in manifest.files}
    for video in stream.videos:
        assert listed[video.file] == (video.size, video.sha256)
    assert set(listed) == {*entry.files, "messages.mcap"}
    span, infos, digests = manifest.time_range, stream.camera_info, stream.digests
    assert span is not None
    assert infos is not None
    assert digests is not None
    parts: list[Any] = [(stream.columns, stream.frames), (infos.columns, infos.messages)]
    for columns, count in parts:
        for _, column in columns:
            assert column is None or len(column.decode(count)) == count
        times = columns.log_time.decode(count)
        assert span.start <= times[0] < times[-1] <= span.end
    assert len(digests.decode(stream.frames)) == stream.frames


@pytest.mark.parametrize("kind", KINDS)
def test_the_examples_are_what_we_write(kind: str, tmp_path: Path) -> None:
    """Key by key, in our order and style: but for the checksum, which they leave out."""
    path = tmp_path / "example.yaml"
    path.write_text(example(kind))
    model = load_stream(path) if kind == "stream" else load_manifest(path)
    written = dump_document(model).decode()
    assert written.rsplit("checksum: ", 1)[0] == example(kind)
    assert document_of(model)["kind"] == kind


# ---------------------------------------------------------------- tools and examples


def links(path: Path) -> Iterator[tuple[str, str]]:
    text = re.sub(r"```.*?```", "", path.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" not in target and not target.startswith("mailto:"):
            file, _, anchor = target.partition("#")
            yield file, anchor


def anchors(path: Path) -> set[str]:
    titles = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize(
    "path",
    [
        *sorted(ROOT.glob("*.md")),
        *sorted(SPEC.glob("*.md")),
        *sorted((ROOT / "docs").rglob("*.md")),
        ROOT / "conformance" / "README.md",
    ],
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_links_resolve(path: Path) -> None:
    for file, anchor in links(path):
        target = (path.parent / file).resolve() if file else path
        assert target.exists(), f"{path.name} -> {file}"
        if anchor and target.suffix == ".md":
            assert anchor in anchors(target), f"{path.name} -> {file}#{anchor}"
