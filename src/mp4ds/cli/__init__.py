"""The command line: the only place that prints or exits.

Exit codes: 0 success; 1 failure, or problems were found; 2 wrong input or options; 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Annotated, NoReturn

import typer

from mp4ds._version import __version__
from mp4ds.cli.options import Command, QuietFlag, quietable
from mp4ds.cli.output import be_quiet, say
from mp4ds.cli.process import DEBUG, exit_code_of, prepare_process

_COMPLETE = "_MP4DS_COMPLETE"  # set by shells for completion

COMMANDS = {
    "pack": ("packing", "Pack a recording into a dataset of mp4 files, or repack a dataset."),
    "repack": ("packing", "Pack a recording into a dataset of mp4 files, or repack a dataset."),
    "unpack": (
        "unpacking",
        "Turn a dataset back into a recording: a bag, rosbag2, MCAP or images.",
    ),
    "import": (
        "importing",
        "Make a dataset from images, or from a video made by the paper's tool.",
    ),
    "export": (
        "unpacking",
        "Export a dataset to another tool's format, keeping what that format supports.",
    ),
    "play": (
        "play",
        "Play back datasets, publishing to ROS 1 or ROS 2.",
    ),
    "record": (
        "record",
        "Record topics of a live robot, ROS 1 or ROS 2, into a dataset.",
    ),
    "report": (
        "report",
        "Make an HTML report: synchronised cameras, timing, topics, calibrations.",
    ),
    "frames": (
        "report",
        "Save one frame as an image, or many frames as a contact sheet.",
    ),
    "evaluate": (
        "evaluate",
        "Compare encoder settings on clips of a recording: quality, size and time.",
    ),
    "validate": (
        "validate",
        "Check datasets and list every problem; exits with 1 if there are any.",
    ),
    "info": ("info", "Show what is in a recording or a dataset."),
    "demo": (
        "demo",
        "Make a small test recording: two cameras (Bayer and RGB), calibrations, IMU, tf.",
    ),
}
"""Commands -> their module, and what they do."""


def app_for(*names: str, is_completing: bool = False) -> typer.Typer:
    """The command line.

    Args:
        names: Commands to build, with the modules that they use; the others are only listed.
            None: build all.
        is_completing: Whether a shell asks for completions, or for the completion script.
    """
    app = typer.Typer(
        name="mp4ds",
        help="Turn robot camera recordings into ordinary mp4 files, and back again exactly.",
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
            app.command(name, short_help=does, cls=kind)(quietable(made))
    return app


def _top(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    quiet: QuietFlag = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show tracebacks of errors.")
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
    """Placeholder for a command in the list of commands."""


def main() -> NoReturn:
    """Run the command line and exit."""
    arguments = sys.argv[1:]
    prepare_process()
    command = next((word for word in arguments if not word.startswith("-")), "")
    # completion is not built for a command that runs
    is_completing = _COMPLETE in os.environ or not command or command not in COMMANDS
    names = () if _COMPLETE in os.environ else (command,)
    app = app_for(*names, is_completing=is_completing)
    sys.exit(exit_code_of(lambda: app(args=arguments), as_json="--json" in arguments))
