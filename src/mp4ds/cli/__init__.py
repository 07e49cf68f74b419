"""The command line: the only place that prints or exits.

Exit codes: 0 the whole job was done; 1 it failed or problems were found; 2 the input or the
options are wrong; 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Annotated, NoReturn

import typer

from mp4ds._version import __version__
from mp4ds.cli.options import Command
from mp4ds.cli.output import be_quiet, say
from mp4ds.cli.process import DEBUG, exit_code_of, prepare_process

_COMPLETE = "_MP4DS_COMPLETE"  # set by the shell that completes

COMMANDS = {
    "pack": ("packing", "Pack a recording, or a dataset again, into a dataset of mp4 files."),
    "repack": ("packing", "Pack a recording, or a dataset again, into a dataset of mp4 files."),
    "unpack": (
        "unpacking",
        "Write a dataset's recording again: as a bag, rosbag2, MCAP, or images.",
    ),
    "import": ("packing", "Make a dataset of images, or of a video of the paper's tool."),
    "export": (
        "unpacking",
        "Write a dataset in the format of another tool, as far as that can hold it.",
    ),
    "play": (
        "play",
        "Publish datasets as if they were the recording: into ROS 1, ROS 2 or Foxglove.",
    ),
    "report": (
        "report",
        "Make a page of a dataset: all cameras in step, timing, topics, calibrations.",
    ),
    "frames": (
        "report",
        "Save the frame of a time as an image, or many frames as a contact sheet.",
    ),
    "evaluate": (
        "evaluate",
        "Try encoder settings on clips of a recording: quality, size and time.",
    ),
    "validate": ("inspect", "List every problem of datasets; exit code 1 if there is one."),
    "info": ("inspect", "Show what is in a recording or a dataset."),
    "demo": (
        "inspect",
        "Make a small recording: two cameras (Bayer and rgb), calibrations, imu and tf.",
    ),
    "conformance-dump": (
        "inspect",
        "Print what a file holds as JSON, to compare other readers with (conformance/README.md).",
    ),
}
"""Commands -> their module, and what they do."""


def app_for(*names: str, is_completing: bool = False) -> typer.Typer:
    """The command line.

    Args:
        names: Commands that are built, with the modules that they use; the others are only
            listed. None: all are built.
        is_completing: Whether a shell asks for what may follow, or is told how to ask.
    """
    app = typer.Typer(
        name="mp4ds",
        help="Robot camera recordings as ordinary mp4 files, and back again exactly.",
        no_args_is_help=True,
        add_completion=is_completing,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback(invoke_without_command=True)(_top)
    for name, (home, does) in COMMANDS.items():
        if names and name not in names:
            app.command(name, short_help=does)(_listed)
            continue
        module = import_module(f"mp4ds.cli.{home}")
        if name == "import":
            app.add_typer(module.imports, short_help=does)
        else:
            made = getattr(module, name.replace("-", "_"))
            kind = getattr(module, "COMMAND", Command)
            app.command(name, short_help=does, cls=kind)(made)
    return app


def _top(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print errors only, and what --json prints.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show where errors come from.")
    ] = False,
) -> None:
    if quiet:
        be_quiet()
    if verbose:
        os.environ[DEBUG] = "1"
    if version:
        say(f"mp4ds {__version__}")
        raise typer.Exit


def _listed() -> None:
    """Stands for a command in the list of all."""


def main() -> NoReturn:
    """Run the command line and exit."""
    arguments = sys.argv[1:]
    prepare_process()
    command = next((word for word in arguments if not word.startswith("-")), "")
    # what shells complete by is not built for a command that runs
    is_completing = _COMPLETE in os.environ or not command or command not in COMMANDS
    names = () if _COMPLETE in os.environ else (command,)
    app = app_for(*names, is_completing=is_completing)
    sys.exit(exit_code_of(lambda: app(args=arguments), as_json="--json" in arguments))
