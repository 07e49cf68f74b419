"""The documentation site: it builds without a warning, such as of a link, and is complete."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from chromium import chromium
from commands import program
from mp4ds.cli import COMMANDS
from mp4ds.cli import commands as command_line
from remote_servers import Many, serving

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.slow  # to build it takes half a minute
for _module in ("mkdocs", "material", "mkdocstrings_handlers.python"):
    pytest.importorskip(_module, reason="needs pip install 'mp4ds[docs]'")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as it would be published."""
    folder = tmp_path_factory.mktemp("site")
    command = (sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder)
    program(*command, cwd=ROOT, env={"NO_MKDOCS_2_WARNING": "1"})
    assert len(list(folder.rglob("index.html"))) > 40
    return folder


# ---------------------------------------------------------------- completeness


def commands() -> dict[str, Any]:
    found: dict[str, Any] = {name: command_line.get_command(None, name) for name in COMMANDS}
    found.pop("repack")  # another name of `pack`
    below = found.pop("import").commands
    return {**found, **{f"import-{name}": one for name, one in below.items()}}


@pytest.mark.parametrize("name", sorted(commands()))
def test_every_option_is_on_its_commands_page(name: str, site: Path) -> None:
    command = commands()[name]
    page = (site / "commands" / name / "index.html").read_text()
    assert command.help.splitlines()[0].split("`")[0] in page
    for parameter in command.params:
        for word in (*parameter.opts, *parameter.secondary_opts):
            is_there = re.search(rf"{re.escape(word)}(?![\w-])", page)
            assert is_there or not word.startswith("-") or parameter.hidden, word


def test_every_public_name_is_in_the_reference(site: Path) -> None:
    pages = [path.read_text() for path in (site / "api").rglob("index.html")]
    anchors = {name for page in pages for name in re.findall(r'id="(mp4ds\.[\w.]+)"', page)}
    names = {f"mp4ds.{name}" for name in mp4ds.__all__ if not name.startswith("__")}
    assert names <= anchors
    assert {"mp4ds.torch.FrameDataset", "mp4ds.Topic.read", "mp4ds.Dataset.sync"} <= anchors
    for kind in (mp4ds.PackOptions, mp4ds.ExportOptions):
        fields = kind.__dataclass_fields__
        assert all(any(f"<code>{name}</code>" in page for page in pages) for name in fields), kind


def test_the_reference_has_nothing_private(site: Path) -> None:
    """And of nothing that only the package itself uses."""
    page = (site / "api" / "reading" / "index.html").read_text()
    members = re.findall(r'<h3 id="mp4ds\.Dataset\.(\w+)"', page)
    assert set(members) == {"topics", "channels", "profile", "messages", "sync", "close"}
    for path in (site / "api").rglob("index.html"):
        text = re.sub("<[^>]+>", "", path.read_text())
        assert re.findall(r"(?<![\w.])_[A-Za-z]\w+", text) == [], path


# ---------------------------------------------------------------- looks


@pytest.fixture(scope="module")
def served(site: Path) -> Iterator[str]:
    handler = partial(SimpleHTTPRequestHandler, directory=str(site))
    with serving(Many(("127.0.0.1", 0), handler)) as url:
        yield f"{url}/"


@pytest.mark.browser
@pytest.mark.parametrize("width", [pytest.param(1400, marks=pytest.mark.slow), 390])
def test_no_page_is_wider_than_the_window(width: int, served: str, tmp_path: Path) -> None:
    """And none asks another server, or has an error."""
    with chromium(tmp_path, width=width, height=900) as tab:
        for page in ("", "commands/pack/", "api/reading/", "spec/", "conversions/", "faq/"):
            ready = "document.readyState === 'complete' && !!document.querySelector('h1')"
            tab.open("about:blank", ready="true")
            tab.open(served + page, ready=ready)
            wide = tab.evaluate("document.documentElement.scrollWidth - innerWidth")
            assert wide <= 0, page
        assert [
            url for url in tab.requests if not url.startswith((served, "about:", "data:"))
        ] == []
        assert tab.problems == []
