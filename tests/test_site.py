"""The documentation site: it builds without a warning, is complete, and all its links lead on."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urljoin, urlsplit

import pytest

import mp4ds
from chromium import chromium
from mp4ds.cli import COMMANDS
from mp4ds.cli import commands as command_line
from waiting import WATCHDOG_S

ROOT = Path(__file__).parents[1]
for _module in ("mkdocs", "material", "mkdocstrings_handlers.python"):
    pytest.importorskip(_module, reason="needs pip install 'mp4ds[docs]'")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as it would be published."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=WATCHDOG_S,
        check=False,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


# ---------------------------------------------------------------- links


@dataclass
class Seen(HTMLParser):
    """What a page refers to, and what can be referred to on it."""

    links: list[str] = field(default_factory=list)
    loaded: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        elif tag in ("script", "img", "source", "iframe") and "src" in given:
            self.loaded.append(given["src"])
        elif tag == "link" and given.get("rel") in ("stylesheet", "icon"):
            self.loaded.append(given["href"])


def problems_of(site: Path, home: str, repository: str) -> list[str]:
    """What is wrong with the links of a site.

    Args:
        site: Its folder.
        home: Its address.
        repository: That of the repository, to whose files links may lead.
    """
    pages = {}
    for path in site.rglob("*.html"):
        pages[path] = Seen()
        pages[path].feed(path.read_text())
    found = []
    for path, seen in pages.items():
        where = urljoin(home, path.relative_to(site).as_posix().removesuffix("index.html"))
        for link in (*seen.links, *seen.loaded):
            url = urljoin(where, link)
            parts = urlsplit(url)
            if url.startswith(repository) and not _is_in_repository(parts.path, repository):
                found.append(f"{path}: {link}: not in the repository")
            if not url.startswith(home):
                if link in seen.loaded:
                    found.append(f"{path}: {link}: loaded from elsewhere")
                continue
            target = site / unquote(parts.path.removeprefix(urlsplit(home).path))
            target = target / "index.html" if target.is_dir() else target
            if not target.is_file():
                found.append(f"{path}: {link}: no such file")
            elif parts.fragment and target in pages and not _has(pages[target], parts.fragment):
                found.append(f"{path}: {link}: no such anchor")
    return found


def _has(page: Seen, fragment: str) -> bool:
    return unquote(fragment) in page.anchors


def _is_in_repository(path: str, repository: str) -> bool:
    found = re.fullmatch(
        r"/(?:blob|tree|edit|raw)/main/(.+)", path[len(urlsplit(repository).path) :]
    )
    return not found or (ROOT / unquote(found[1])).exists()


def address(name: str) -> str:
    text = (ROOT / "pyproject.toml").read_text()
    return re.findall(rf'^{name} = "(.*)"$', text, re.MULTILINE)[0]


def test_every_link_leads_somewhere(site: Path) -> None:
    assert len(list(site.rglob("index.html"))) > 40
    assert problems_of(site, address("Documentation"), address("Repository")) == []


@pytest.mark.parametrize(
    ("html", "problem"),
    [
        ('<a href="#there">', "no such anchor"),
        ('<a href="other/">', "no such file"),
        ('<script src="https://elsewhere.org/x.js">', "loaded from elsewhere"),
        ('<a href="https://host/mp4ds/blob/main/no.md">', "not in the repository"),
    ],
)
def test_a_link_that_leads_nowhere_is_found(html: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text(f'{html}<p id="here"><a href="#here">')
    (found,) = problems_of(tmp_path, "https://docs.org/mp4ds/", "https://host/mp4ds")
    assert found.endswith(problem)


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


def test_the_reference_is_of_what_programs_use(site: Path) -> None:
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
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(site)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    thread.join()
    server.server_close()


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
