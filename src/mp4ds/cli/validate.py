"""``mp4ds validate``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from mp4ds.cli.options import DatasetsArgument, JobsOption, JsonFlag, cores
from mp4ds.cli.output import print_json, print_validation
from mp4ds.cli.process import report_errors
from mp4ds.cli.progress import progress_of
from mp4ds.dataset import checks
from mp4ds.dataset.collections import datasets_in, each


def validate(
    paths: DatasetsArgument,
    deep: Annotated[
        bool,
        typer.Option(
            "--deep", help="Also hash and decode every file and check every message's digest."
        ),
    ] = False,
    jobs: JobsOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Check datasets and list every problem; exits with 1 if there are any."""
    found: dict[Path, list[checks.Problem]] = {}
    with report_errors(as_json), progress_of("validating", as_json) as tell:
        where = datasets_in(paths)
        if len(where) == 1:
            found[where[0]] = checks.validate(where[0], deep=deep, progress=tell)
        else:
            for path, problems in each(partial(checks.validate, deep=deep), where, cores(jobs)):
                found[path] = problems
                if tell:
                    tell(f"{len(found)} of {len(where)} datasets", len(found) / len(where))
    if as_json:
        told = [{"path": path, "deep": deep, "problems": item} for path, item in found.items()]
        print_json(told[0] if len(told) == 1 else told)
    else:
        print_validation(found, deep=deep)
    raise typer.Exit(1 if any(found.values()) else 0)
