"""Options that several commands have."""

from __future__ import annotations

from typing import Annotated, Optional

import typer

JsonFlag = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
TopicsOption = Annotated[
    Optional[list[str]],  # noqa: UP045 - read at run time by typer
    typer.Option("--topics", "-t", metavar="GLOB", help="Only topics that match; may be repeated."),
]
ExcludeOption = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--exclude", "-x", metavar="GLOB", help="Leave out topics that match."),
]
ForceFlag = Annotated[bool, typer.Option("--force", "-f", help="Replace an existing output.")]
ResizeOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--resize", metavar="0.5|WxH", help="Smaller images, calibrations to match."),
]
EveryOption = Annotated[
    int, typer.Option("--every", min=1, metavar="N", help="Every Nth frame only.")
]
MaxRateOption = Annotated[
    Optional[float],  # noqa: UP045
    typer.Option("--max-rate", metavar="HZ", help="So many frames a second at most."),
]
