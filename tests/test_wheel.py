"""What is released: the sdist, the wheels made of it, and what else says what they are."""

from __future__ import annotations

import email
import re
import shutil
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from email.message import Message
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import mp4ds
from commands import program

ROOT = Path(__file__).parents[1]
for _module in ("hatchling", "hatch_fancy_pypi_readme"):
    pytest.importorskip(_module)
VERSION = mp4ds.__version__


def built(kind: str, source: Path, target: Path, **environment: str) -> Path:
    """What hatchling makes of a source tree offline: an ``sdist``, a ``wheel`` or ``editable``."""
    code = f"import hatchling.build as b, sys; print(b.build_{kind}(sys.argv[1]))"
    env = {"PYTHONDONTWRITEBYTECODE": "1", **environment}
    return target / program("-c", code, target, cwd=source, env=env).out.split()[-1]


def contents(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("sdist", ROOT, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def unpacked(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unpacked")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, **({"filter": "data"} if sys.version_info >= (3, 12) else {}))
    return folder / f"mp4ds-{VERSION}"


@pytest.fixture(scope="module")
def pure(unpacked: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[zipfile.ZipFile]:
    target = tmp_path_factory.mktemp("pure")
    with zipfile.ZipFile(built("wheel", unpacked, target, MP4DS_PURE="1")) as wheel:
        yield wheel


def metadata_of(wheel: zipfile.ZipFile, name: str = "METADATA") -> Message:
    text = wheel.read(f"mp4ds-{VERSION}.dist-info/{name}").decode()
    return email.message_from_string(text)


# ---------------------------------------------------------------- contents


def test_the_pure_wheel_has_what_the_package_needs_and_no_more(pure: zipfile.ZipFile) -> None:
    names = set(pure.namelist())
    source = ROOT / "src" / "mp4ds"
    expected = {
        f"mp4ds/{path.relative_to(source).as_posix()}"
        for path in source.rglob("*")
        if path.is_file() and path.suffix not in (".c", ".pyc", ".so")
    }
    expected |= {
        f"mp4ds/{path.relative_to(ROOT).as_posix()}" for path in (ROOT / "schemas").rglob("*.json")
    }
    assert {name for name in names if name.startswith("mp4ds/")} == expected
    assert {"mp4ds/py.typed", "mp4ds/plugins/reporting/page/report.js"} <= expected
    assert "mp4ds/schemas/v1.0/stream.schema.json" in expected
    others = {name.split("/", 1)[1] for name in names - expected}
    assert others == {"METADATA", "RECORD", "WHEEL", "entry_points.txt", "licenses/LICENSE"}
    assert metadata_of(pure, "WHEEL")["Tag"] == "py3-none-any"


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")
def test_a_compiled_wheel_is_for_its_platform(unpacked: Path, tmp_path: Path) -> None:
    source = shutil.copytree(unpacked, tmp_path / "source")
    before = contents(source)
    # PYTHONDONTWRITEBYTECODE as most have it, or rather have it not
    path = built("wheel", source, tmp_path, MP4DS_PURE="0", PYTHONDONTWRITEBYTECODE="")
    assert contents(source) == before  # nothing is compiled into the checkout
    with zipfile.ZipFile(path) as wheel:
        assert "mp4ds/video/_colour.so" in wheel.namelist()
        assert "mp4ds/video/colour.c" not in wheel.namelist()
        assert re.fullmatch(r"py3-none-(linux|macosx)_\w+", metadata_of(wheel, "WHEEL")["Tag"])
        wheel.extractall(tmp_path / "installed")
    code = "import mp4ds.video.colour as c; assert c.compiled() is not None; print(c.__file__)"
    installed = str(tmp_path / "installed")
    done = program("-c", code, cwd=tmp_path, env={"PYTHONPATH": installed})
    assert done.out.startswith(installed)


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")
def test_an_editable_install_is_compiled_where_it_runs(unpacked: Path, tmp_path: Path) -> None:
    source = shutil.copytree(unpacked, tmp_path / "source")
    before = contents(source)
    with zipfile.ZipFile(built("editable", source, tmp_path, MP4DS_PURE="0")) as wheel:
        assert not [name for name in wheel.namelist() if name.endswith(".so")]
    made = contents(source) - before
    assert made == {"src/mp4ds/video/_colour.so"}
    with zipfile.ZipFile(built("wheel", source, tmp_path, MP4DS_PURE="1")) as wheel:
        assert not [name for name in wheel.namelist() if name.endswith(".so")]


def test_the_sdist_has_its_tests_and_no_build_files(unpacked: Path) -> None:
    for name in ("tests/test_wheel.py", "tools/test.sh", "src/mp4ds/video/colour.c", "LICENSE"):
        assert (unpacked / name).is_file(), name
    names = [path.relative_to(unpacked).parts for path in unpacked.rglob("*")]
    rubbish = {".venv", "build", "dist", "__pycache__", "quickstart"}
    assert not [parts for parts in names if rubbish & {*parts} or parts[-1].endswith(".so")]


NOTEBOOKS = "https://colab.research.google.com/github/mp4ds/mp4ds/blob/main/"


def test_links_on_pypi_are_absolute(pure: zipfile.ZipFile) -> None:
    metadata = metadata_of(pure)
    text = str(metadata.get_payload())
    targets = re.findall(r"\]\(([^)]+)\)", text)
    assert len(targets) > 15
    for target in targets:
        if target.startswith(NOTEBOOKS):
            assert (ROOT / target.removeprefix(NOTEBOOKS)).exists(), target
            continue
        found = re.fullmatch(
            r"https://[\w.]+/mp4ds/mp4ds/(?:blob/)?v([\d.a-z]+)/([^#]+)(#.+)?", target
        )
        assert found, target
        assert found[1] == VERSION
        assert (ROOT / found[2]).exists(), target
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert metadata["License-Expression"] == "Apache-2.0"
    urls = dict(url.split(", ") for url in metadata.get_all("Project-URL", []))
    assert {"Documentation", "Repository", "Changelog", "Issues"} == set(urls)


# ---------------------------------------------------------------- what else says the same


def texts() -> Iterator[tuple[Path, str]]:
    """Files that name addresses of the project."""
    patterns = ("*.md", "*.toml", "*.cff", "*.yml", "Dockerfile*", "conda/*", ".github/**/*.yml")
    patterns += ("ros/*.yaml", "ros/mp4ds/*.xml")
    for pattern in (*patterns, "docs/**/*.md", "spec/*.md"):
        for path in ROOT.glob(pattern):
            yield path, path.read_text()


def test_the_project_has_one_address() -> None:
    pyproject = (ROOT / "pyproject.toml").read_text()
    repository = re.findall(r'^Repository = "(.*)"$', pyproject, re.MULTILINE)[0]
    site = re.findall(r'^Documentation = "(.*)"$', pyproject, re.MULTILINE)[0]
    raw = repository.replace("https://github.com", "https://raw.githubusercontent.com")
    count = 0
    for path, text in texts():
        for url in re.findall(r"https://[\w./-]*\bmp4ds\b[\w./-]*", text):
            is_ours = url.startswith((repository, site, raw, NOTEBOOKS))
            assert is_ours, f"{path.relative_to(ROOT)}: {url}"
            count += 1
    assert count > 8


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == VERSION
    assert citation["license"] == "Apache-2.0"


def pinned() -> Iterator[Requirement]:
    """What lock/ has, each with hashes of its files and no address."""
    for name in ("run", "test"):
        text = (ROOT / "lock" / f"{name}.txt").read_text()
        head, text = ("", text) if name == "run" else text.split("\n", 1)
        assert head == {"run": "", "test": "--requirement run.txt"}[name]
        for one in re.split(r"\n(?=\w)", text.rstrip()):
            requirement, *hashes = one.split(" \\\n")
            assert all(re.fullmatch(r"    --hash=sha256:[0-9a-f]{64}", line) for line in hashes), (
                one
            )
            assert hashes, one
            yield Requirement(requirement)


@pytest.mark.parametrize("python", ["3.10", "3.11", "3.12", "3.13", "3.14"])
@pytest.mark.parametrize("system", ["linux x86_64", "linux aarch64", "darwin arm64"])
def test_the_lock_meets_all_requirements(python: str, system: str) -> None:
    platform, machine = system.split()
    environment = {"python_version": python, "python_full_version": f"{python}.9", "extra": ""}
    environment |= {"sys_platform": platform, "platform_machine": machine}
    lock: dict[str, list[str]] = {}
    for pin in pinned():
        if not pin.marker or pin.marker.evaluate(environment):
            (version,) = pin.specifier
            lock.setdefault(canonicalize_name(pin.name), []).append(version.version)
    pyproject = (ROOT / "pyproject.toml").read_text()
    starts = r"^(?:requires|dependencies|test) = \[(.*?)\]$"
    asked = re.findall(r'"([^"]+)"', "".join(re.findall(starts, pyproject, re.DOTALL | re.M)))
    assert len(asked) > 40
    for text in asked:
        one = Requirement(text)
        if not one.marker or one.marker.evaluate(environment):
            versions = lock.get(canonicalize_name(one.name), [])
            is_met = len(versions) == 1 and versions[0] in one.specifier
            assert is_met, f"{text}: lock/ has {versions}; bash tools/lock.sh renews it"
