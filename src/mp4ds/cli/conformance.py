"""``mp4ds conformance-dump``."""

from __future__ import annotations

from typing import Annotated

import typer

from mp4ds.cli.failures import told_errors
from mp4ds.cli.output import printed, status_line


def conformance_dump(
    path: Annotated[str, typer.Argument(metavar="FILE", help="A sidecar or a dataset.")],
) -> None:
    """Print what a file holds as JSON, to compare other readers with (conformance/README.md).

    Exit code 1 if it has problems, which are then all that is printed.
    """
    from mp4ds.conformance import as_json
    from mp4ds.conformance import conformance_dump as run

    with told_errors(as_json=True), status_line(as_json=False) as report:
        found = run(path, progress=report)
    with printed():
        print(as_json(found))
    raise typer.Exit(1 if found["problems"] else 0)
