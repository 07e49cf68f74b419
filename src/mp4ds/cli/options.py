"""Options that several commands have."""

from __future__ import annotations

from typing import Annotated, Optional

import typer

DatasetArgument = Annotated[str, typer.Argument(help="A dataset, or a sidecar beside its video.")]
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
JpegQualityOption = Annotated[
    int, typer.Option("--jpeg-quality", min=1, max=100, help="Of JPEG files that are made.")
]

ClusterOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--cluster", metavar="ADDRESS", help="Dask scheduler, tcp://HOST:PORT, or slurm."),
]

# of what makes videos
CodecOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option(
        "--codec",
        help="h264, h265, ffv1 (lossless), av1, av1-10bit (lossy); of a graphics card av1-nvenc, "
        "h264-nvenc, h265-nvenc, ...-vaapi or ...-videotoolbox.",
    ),
]
PresetOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--preset", help="The encoder's preset, such as 6, veryfast or p4."),
]
TranscodeFlag = Annotated[
    bool,
    typer.Option(
        "--transcode", help="Encode JPEG images anew by --quality, instead of copying them."
    ),
]
PurposeOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option(
        "--for",
        metavar="PURPOSE",
        help="archive: smallest files. training: fastest random access.",
    ),
]
GopOption = Annotated[
    Optional[int],  # noqa: UP045
    typer.Option(
        "--gop",
        min=1,
        max=100_000,
        help="Most frames from a key frame to the next; 30 by default, 60 where lossy.",
    ),
]
JobsOption = Annotated[
    Optional[int],  # noqa: UP045
    typer.Option(
        "--jobs", "-j", min=1, max=1024, help="Processes at a time; all cores by default."
    ),
]
MemoryOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--memory", metavar="SIZE", help="Such as 8G; half of the machine's by default."),
]
RestartFlag = Annotated[
    bool, typer.Option("--restart", help="Start over where an unfinished run was left.")
]
