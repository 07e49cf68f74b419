"""What MkDocs adds to the pages of docs/: a hook, which mkdocs.yml names.

The site has the files of the repository in the same places, so that a link that works on the
repository's host works on the site, too; what is no page of the site leads to the repository.
Pages of the commands are made from their parsers, those of the Python API from its names.
"""

from __future__ import annotations

import html
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import mp4ds
from mp4ds.cli import COMMANDS
from mp4ds.cli import commands as command_line
from mp4ds.options import Options, declared_in

ROOT = Path(__file__).resolve().parents[1]
OTHERS = ("*.md", "spec/*.md", "conformance/README.md", "benchmarks/RESULTS.md", "benchmarks/*.svg")
"""Files of the site that are not in docs/."""
API = {
    "pack-unpack": ("Packing and unpacking", ("packing.", "unpacking.", "plugins.importing")),
    "reading": ("Reading", ("dataset.", "times")),
    "plugins": ("Exporting, playing, reporting, evaluating", ("plugins.",)),
    "errors": ("Errors", ("errors",)),
    "torch": ("PyTorch", ("torch.",)),
}
"""Page -> its title, and where the names on it live; a name is on the first page that has it."""
MEMBERS = {
    "Dataset": ("topics", "messages", "sync", "channels", "profile", "close"),
    "Stream": ("topic", "video_path", "columns"),
}
"""Class -> what programs need of it; the rest is for the package itself."""
_HIDDEN = ("repack",)  # another name of `pack`
_COMMANDS = "docs/commands/"
_API = "docs/api/"


# ---------------------------------------------------------------- hooks


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Take the addresses from pyproject.toml, and list generated pages in the navigation."""
    text = (ROOT / "pyproject.toml").read_text()
    config.repo_url = address(text, "Repository")
    config.site_url = address(text, "Documentation")
    config.repo_name = "/".join(config.repo_url.split("/")[-2:])
    config.edit_uri = "edit/main/"
    generated = {
        "commands": [{f"mp4ds {name}": command_page(name)} for name in commands()],
        "api": [{title: f"{_API}{page}.md"} for page, (title, _) in API.items()],
    }
    for group in config.nav or []:
        for pages in group.values():
            if isinstance(pages, list):
                pages[:] = [page for item in pages for page in generated.get(str(item), [item])]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Put files where they are in the repository, and add those that are not in docs/."""
    found = Files([])
    for file in files:
        place = Path(config.docs_dir, file.src_uri)
        found.append(_of_repository(place, config) if place.is_file() else file)
    for pattern in OTHERS:
        for place in sorted(ROOT.glob(pattern)):
            found.append(_of_repository(place, config))
    examples = list(commands_of_pages(found))
    for name, command in commands().items():
        text = command_text(name, command, examples)
        found.append(_generated(command_page(name), text, config))
    for page, (title, _) in API.items():
        found.append(_generated(f"{_API}{page}.md", api_text(page, title), config))
    return found


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let links to what is no page lead to the repository."""
    if page.file.src_uri == "README.md":
        page.meta["hide"] = ["navigation"]
    folder = posixpath.dirname(page.file.src_uri)

    def changed(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, match[2]))
        place = ROOT / target
        if not match[2] or ":" in match[2] or files.get_file_from_path(target):
            return match[0]
        if place.is_dir() and files.get_file_from_path(f"{target}/index.md"):
            return match[0]
        if not place.exists():
            raise PluginError(f"{page.file.src_uri}: there is no {match[2]}")
        kind = "tree" if place.is_dir() else "blob"
        return f"{match[1]}{config.repo_url}/{kind}/main/{target}{match[3]}"

    # in tables, GitHub wants a pipe within code escaped, and Python-Markdown does not
    markdown = re.sub("`[^`\n]+`", lambda code: code[0].replace("\\|", "|"), markdown)
    return re.sub(r"(\]\()([^)#\s]*)((?:#[^)\s]*)?\))", changed, markdown)


def address(text: str, name: str) -> str:
    """A URL of the project, from the text of pyproject.toml."""
    found = re.search(rf'^{name} = "(.*)"$', text, re.MULTILINE)
    if not found:
        raise PluginError(f"pyproject.toml, project.urls: has no {name}")
    return found[1]


def _of_repository(place: Path, config: MkDocsConfig) -> File:
    """A file in its place in the repository; README.md is the first page, docs/ the root."""
    uri = place.relative_to(ROOT).as_posix()
    made = File(uri, str(ROOT), config.site_dir, use_directory_urls=True)
    made.dest_uri = _dest(made.dest_uri, uri)
    return made


def _generated(uri: str, text: str, config: MkDocsConfig) -> File:
    made = File.generated(config, uri, content=text)
    made.dest_uri = _dest(made.dest_uri, uri)
    made.edit_uri = None
    return made


def _dest(dest: str, uri: str) -> str:
    return "index.html" if uri == "README.md" else dest.removeprefix("docs/")


# ---------------------------------------------------------------- commands


def commands() -> dict[str, Any]:
    """All commands of the command line, those of groups by both words."""
    found: dict[str, Any] = {}
    for name in COMMANDS:
        command: Any = command_line.get_command(None, name)
        if hasattr(command, "commands"):
            found.update({f"{name} {below}": one for below, one in command.commands.items()})
        elif name not in _HIDDEN:
            found[name] = command
    return found


def command_page(name: str) -> str:
    """Where the page of a command is."""
    return f"{_COMMANDS}{name.replace(' ', '-')}.md"


def command_text(name: str, command: Any, examples: list[tuple[str, str, Page | str]]) -> str:
    """The page of a command."""
    context = click.Context(command, info_name=f"mp4ds {name}")
    kinds = [kind for kind in getattr(command.callback, "kinds", ()) if is_public(kind)]
    parts = [f"# mp4ds {name}\n", _paragraphs(command.help)]
    usage = " ".join(["mp4ds", name, *command.collect_usage_pieces(context)])
    parts.append(f"```text\n{usage}\n```\n")
    parts += _examples(name, examples)
    for panel, rows in command.panels(context).items():
        parts.append(f"## {panel}\n")
        told = [(words, _text(text), _field(key, kinds)) for key, words, text in rows]
        parts.append(
            _table(("", "", "in Python") if any(row[2] for row in told) else ("", ""), told)
        )
    if kinds:
        names = ", ".join(f"[`{kind.__name__}`][mp4ds.{kind.__name__}]" for kind in kinds)
        parts.append(f"In Python these are fields of {names}.\n")
    return "\n".join(parts)


def _paragraphs(text: str) -> str:
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n")) + "\n"


def _field(key: str, kinds: list[type[Options]]) -> str:
    return _code(key) if any(key in dict(declared_in(kind)) for kind in kinds) else ""


def _text(text: str) -> str:
    """A help text in Markdown."""
    return html.escape(text.strip(), quote=False).replace("|", "\\|").replace("*", "\\*")


def _code(words: str) -> str:
    """Words of a command line, in one line where there is room."""
    return f'<code class="words">{html.escape(words).replace("|", "&#124;")}</code>'


def _table(header: tuple[str, ...], rows: list[tuple[str, str, str]]) -> str:
    lines = [f"| {' | '.join(header)} |", f"|{' --- |' * len(header)}"]
    for words, *others in rows:
        told = _code(words)
        lines.append(f"| {' | '.join([told, *others][: len(header)])} |")
    return "\n".join(lines) + "\n"


def commands_of_pages(files: Files) -> Iterator[tuple[str, str, str]]:
    """Command lines of all pages: the line, the page's title and its place."""
    for file in files.documentation_pages():
        if not file.src_uri.startswith(("docs/", "README")):
            continue
        text = (ROOT / file.src_uri).read_text()
        title = re.search(r"^# (.*)$", text, re.MULTILINE)
        for block in re.findall(r"```(?:sh|console)\n(.*?)```", text, re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                found = re.match(r"(?:\$ )?(mp4ds [^\n]*)$", line)
                if found and title:
                    yield " ".join(found[1].split()), title[1], file.src_uri


def _examples(name: str, examples: list[tuple[str, str, str]]) -> Iterator[str]:
    """Command lines that say something of themselves, and the pages that use the command."""
    mine = [one for one in examples if re.match(rf"mp4ds {name}\b(?!-)", one[0])]
    said = {line: None for line, _, _ in mine if " # " in line and "exit code" not in line}
    if said or mine:
        yield "## Examples\n"
        lines = [*said][:8] or list(dict.fromkeys(line for line, _, _ in mine))[:4]
        told = [re.sub(r"(.*?) +# (.*)", r"# \2\n\1\n", line) for line in lines]
        yield "```sh\n" + "\n".join(told).strip() + "\n```\n"
        pages = {place: title for _, title, place in mine if place != "README.md"}
        home = posixpath.dirname(command_page(name))
        links = [f"[{title}]({posixpath.relpath(place, home)})" for place, title in pages.items()]
        yield f"More on {', '.join(links)}.\n"


# ---------------------------------------------------------------- Python


def api_text(page: str, title: str) -> str:
    """The page of a part of the API; mkdocstrings makes the rest of it from the docstrings."""
    parts = [f"# {title}\n"]
    if page == "torch":  # what the module says of itself
        parts += ["::: mp4ds.torch", "    options: {members: false, show_root_heading: false}"]
        parts += ["\nMore on this: [frames in PyTorch](../training.md).\n"]
    for name in names_of(page):
        value = None if page == "torch" else getattr(mp4ds, name)
        is_options = isinstance(value, type) and issubclass(value, Options)
        parts.append(f"::: mp4ds.{'torch.' if page == 'torch' else ''}{name}")
        if is_options:  # its fields follow, as a table
            hidden = ("members", "show_bases", "show_signature")
            parts.append("    options:\n" + "\n".join(f"      {name}: false" for name in hidden))
        elif name in MEMBERS:
            parts.append(f"    options:\n      members: {list(MEMBERS[name]) or 'false'}")
        parts.append("")
        if is_options and value:
            parts += [_options_table(value), ""]
    return "\n".join(parts)


def names_of(page: str) -> list[str]:
    """The names that are on a page."""
    if page == "torch":  # which is not imported where there is no PyTorch
        text = (ROOT / "src/mp4ds/torch/__init__.py").read_text()
        return list(re.findall(r'"(\w+)"', text.rpartition("__all__")[2]))
    found = []
    for name in mp4ds.__all__:
        value = getattr(mp4ds, name)
        home = getattr(value, "__module__", "").removeprefix("mp4ds.")
        pages = [key for key, (_, homes) in API.items() if home.startswith(homes)]
        if not name.startswith("__") and pages[:1] == [page]:
            found.append(name)
    return sorted(found, key=lambda name: (name[0].isupper(), name))


def is_public(kind: type[Options]) -> bool:
    """Whether a class of options is one of the package's names."""
    return getattr(mp4ds, kind.__name__, None) is kind


def _options_table(kind: type[Options]) -> str:
    """Fields, their defaults, and what they are."""
    lines = ["| field | default | |", "| --- | --- | --- |"]
    for name, shown in declared_in(kind):
        lines.append(f"| `{name}` | `{getattr(kind, name)!r}` | {_text(shown.help)} |")
    return "\n".join(lines)
