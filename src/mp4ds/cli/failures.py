"""Errors raised on purpose, as one sentence and an exit code."""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

import typer

from mp4ds.cli.output import print_json, shown
from mp4ds.errors import Mp4dsError

_AGAIN = "run the same command again to go on"
_BAD_PATH = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EACCES, errno.EINVAL)


@contextmanager
def told_errors(as_json: bool) -> Iterator[None]:
    """Turn errors raised on purpose into one sentence and an exit code."""
    try:
        yield
    except KeyboardInterrupt as interrupt:
        _fail(str(interrupt) or "interrupted; nothing unfinished was left behind", 130, as_json)
    except SystemExit as ended:  # by SIGTERM
        _fail("ended; what is finished of a pack in parts is kept: " + _AGAIN, ended.code, as_json)
    except Mp4dsError as error:
        _fail(str(error), error.exit_code, as_json)
    except OSError as error:
        # a path that the system itself refuses, wherever it was met
        code = 2 if error.errno in _BAD_PATH else 1
        _fail(f"{error.filename or 'a file'}: {error.strerror or error}", code, as_json)
    except MemoryError:
        _fail("out of memory; try fewer --jobs", 1, as_json)


def _fail(message: str, code: Any, as_json: bool) -> NoReturn:
    if as_json:
        print_json({"error": message, "exit_code": code})
    print(f"mp4ds: {shown(message)}", file=sys.stderr)
    raise typer.Exit(code)
