"""Counts the house: lines of code and modules by room, and the modules on the ways of one image.

    python tools/count.py

A line of code is one that is not blank, a comment or a docstring. On a way are the modules of which
a function runs: for one image more of a recording that is packed, and for ``stream[7]``. The last
two lines count all code and the core.
"""

from __future__ import annotations

import ast
import sys
import tempfile
import threading
import tokenize
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import mp4ds
from mp4ds.plugins.demo import demo

SOURCE = Path(mp4ds.__file__).parent
ROOT = Path(__file__).resolve().parents[1]
BLANK = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT),
    *(tokenize.ENCODING, tokenize.ENDMARKER),
}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def code_lines(path: Path) -> int:
    """Lines of a module that are code."""
    lines: set[int] = set()
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type not in BLANK:
                lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            text = node.body[0]
            lines -= set(range(text.lineno, (text.end_lineno or text.lineno) + 1))
    return len(lines)


def within_functions(tree: ast.AST) -> int:
    """How many imports of the package are inside of functions."""
    return sum(
        isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mp4ds")
        for function in ast.walk(tree)
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef))
        for node in ast.walk(function)
    )


def modules_run(work: Callable[[], object]) -> Counter[str]:
    """Calls of functions, by module of the package."""
    calls: Counter[str] = Counter()

    def see(frame: FrameType, event: str, _: object) -> None:
        path = frame.f_code.co_filename
        if event == "call" and path.startswith(str(SOURCE)):
            calls[str(Path(path).relative_to(SOURCE))] += 1

    threading.setprofile(see)
    sys.setprofile(see)
    try:
        work()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]
    return calls


def packed(folder: Path, seconds: float) -> Counter[str]:
    """Calls while the images of a camera that records so long are packed."""
    bag = folder / f"{seconds}.bag"
    demo(bag, seconds=seconds)
    options = mp4ds.PackOptions(topics=["/left/image_raw"])
    return modules_run(lambda: mp4ds.pack(bag, folder / f"{seconds}", options))


def main() -> None:
    """Print the figures."""
    lines, files = Counter[str](), Counter[str]()
    classes = imports = 0
    for path in SOURCE.rglob("*.py"):
        room = path.relative_to(SOURCE).parts[0]
        lines[room] += code_lines(path)
        files[room] += 1
        tree = ast.parse(path.read_text())
        classes += sum(isinstance(node, ast.ClassDef) for node in ast.walk(tree))
        imports += within_functions(tree)
    for room, count in lines.most_common():
        print(f"{count:6} lines {files[room]:4} files  {room}")
    for name in ("tests", "tools", "conformance"):
        paths = [*(ROOT / name).rglob("*.py")]
        print(f"{sum(map(code_lines, paths)):6} lines {len(paths):4} files  ({name})")
    print(f"{classes:6} classes")
    print(f"{imports:6} imports of mp4ds inside of functions")
    with tempfile.TemporaryDirectory() as name:
        packed(Path(name), 0.1)  # what is imported once
        long, short = packed(Path(name), 3.0), packed(Path(name), 2.0)
        # what one image costs is what a longer recording calls more often
        more = sorted(module for module in long if long[module] > short[module])
        print(f"{len(more):6} modules for one more image in pack: {' '.join(more)}")
        with mp4ds.open(Path(name) / "3.0") as dataset:
            stream = dataset[dataset.topics[0]]
            found = sorted(modules_run(lambda: stream[7]))
        print(f"{len(found):6} modules for stream[7]: {' '.join(found)}")
    core = lines.total() - lines["plugins"]
    print(f"{core:6} lines {files.total() - files['plugins']:4} files  core (all but plugins)")
    print(f"{lines.total():6} lines {files.total():4} files  all")


if __name__ == "__main__":
    main()
