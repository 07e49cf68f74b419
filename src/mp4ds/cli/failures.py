"""Errors, as one sentence and an exit code."""

from __future__ import annotations

import errno
import os
import platform
import re
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

import typer

from mp4ds._version import __version__
from mp4ds.cli.output import complain, print_json
from mp4ds.errors import Mp4dsError, sentence_of

_AGAIN = "run the same command again to go on"
_BAD_PATH = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EACCES, errno.EINVAL)
_DEBUG = "MP4DS_DEBUG"
_NO_MEMORY = "out of memory; try fewer --jobs"
_MEMORY_REFUSED = ("can't start new thread", "failed to map segment", "Cannot allocate memory")
_LONGEST = 500
_PACKAGE = Path(__file__).parents[1]


@contextmanager
def told_errors(as_json: bool) -> Iterator[None]:
    """Turn errors into one sentence and an exit code."""
    try:
        yield
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except KeyboardInterrupt as interrupt:
        _fail(str(interrupt) or "interrupted; nothing unfinished was left behind", 130, as_json)
    except SystemExit as ended:  # by SIGTERM
        _fail("ended; what is finished of a pack in parts is kept: " + _AGAIN, ended.code, as_json)
    except Mp4dsError as error:
        _fail(str(error), error.exit_code, as_json)
    except OSError as error:
        # a path that the system itself refuses, wherever it was met
        code = 2 if error.errno in _BAD_PATH else 1
        _fail(sentence_of(error), code, as_json)
    except MemoryError:
        _fail(_NO_MEMORY, 1, as_json)
    except Exception as error:
        # what a system without memory says where it is not asked for memory itself
        if any(words in str(error) for words in _MEMORY_REFUSED):
            _fail(_NO_MEMORY, 1, as_json)
        _fail(_unexpected(error), 1, as_json, versions=_versions())


def _fail(
    message: str, code: Any, as_json: bool, *, versions: dict[str, str] | None = None
) -> NoReturn:
    if os.environ.get(_DEBUG):
        for line in traceback.format_exc().splitlines():
            complain(line)
    if as_json:
        with suppress(Mp4dsError):  # nobody takes it
            print_json(
                {"error": message, "exit_code": code} | ({"versions": versions} if versions else {})
            )
    complain(message)
    if versions:
        complain(", ".join(f"{name} {version}" for name, version in versions.items()))
    raise typer.Exit(code)


def _unexpected(error: Exception) -> str:
    """A sentence about an error that nobody thought of."""
    said = " ".join(str(error).split())[:_LONGEST].rstrip(".") or "no more is told"
    place = ""
    for frame in traceback.extract_tb(error.__traceback__):
        path = Path(frame.filename)
        if _PACKAGE in path.parents:
            place = f" in {path.relative_to(_PACKAGE).as_posix()}:{frame.lineno}"
    return (
        f"{type(error).__name__}{place}: {said}. This is not meant to happen: please report it, "
        f"with the versions told here and what {_DEBUG}=1 shows."
    )


def _versions() -> dict[str, str]:
    """What is at work, and the version of each."""
    from importlib import metadata

    found = {"mp4ds": __version__, "Python": platform.python_version()}
    with suppress(metadata.PackageNotFoundError):
        for requirement in metadata.requires("mp4ds") or ():
            name, _, condition = requirement.partition(";")
            name = re.split(r"[^\w.-]", name, maxsplit=1)[0]
            if name in found or "extra == 'test'" in condition.replace('"', "'"):
                continue
            try:
                found[name] = metadata.version(name)
            except metadata.PackageNotFoundError:
                if "extra ==" not in condition:
                    found[name] = "missing"
    with suppress(Exception):  # it may be what is at fault
        from mp4ds.video import tool_versions

        found.update(tool_versions())
    return found | {"on": platform.platform()}
