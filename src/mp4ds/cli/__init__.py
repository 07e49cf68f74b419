"""The command line: the only place that prints or exits.

Exit codes: 0 success; 1 failure, or problems were found; 2 wrong input or options; 130 interrupted.
"""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module
from typing import Any, NoReturn

import click

from mp4ds._version import __version__
from mp4ds.cli.options import quiet_option
from mp4ds.cli.output import say
from mp4ds.cli.process import DEBUG, exit_code_of, prepare_process, report_errors

COMMANDS = {
    "pack": ("pack", "Pack a recording into a dataset of mp4 files, or repack a dataset."),
    "repack": ("pack", "Pack a recording into a dataset of mp4 files, or repack a dataset."),
    "unpack": ("pack", "Turn a dataset back into a recording: a bag, rosbag2, MCAP or images."),
    "import": ("exchange", "Make a dataset from images, or from a video made by the paper's tool."),
    "export": (
        "exchange",
        "Export a dataset to another tool's format, keeping what that format supports.",
    ),
    "play": ("play", "Play back datasets, publishing to ROS 1 or ROS 2."),
    "record": ("record", "Record topics of a live robot, ROS 1 or ROS 2, into a dataset."),
    "report": (
        "report",
        "Make an HTML report: synchronised cameras, timing, topics, calibrations.",
    ),
    "frames": ("report", "Save one frame as an image, or many frames as a contact sheet."),
    "evaluate": (
        "report",
        "Compare encoder settings on clips of a recording: quality, size and time.",
    ),
    "validate": (
        "info",
        "Check datasets and list every problem; exits with 1 if there are any.",
    ),
    "info": ("info", "Show what is in a recording or a dataset."),
    "demo": (
        "exchange",
        "Make a small test recording: two cameras (Bayer and RGB), calibrations, IMU, tf.",
    ),
}
"""Commands -> their module, which is imported for them alone, and what they do."""


class Commands(click.Group):
    """The command line, with the commands of the table."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The names."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context | None, cmd_name: str) -> click.Command | None:
        """The command of a name."""
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = getattr(
            import_module(f"mp4ds.cli.{COMMANDS[cmd_name][0]}"), f"{cmd_name}_command"
        )
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write what they do, without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, does) for name, (_, does) in COMMANDS.items()])

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command, and report its errors."""
        with report_errors():
            return super().invoke(ctx)


@click.group(
    cls=Commands,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.option("--version", is_flag=True, help="Print the version.")
@quiet_option
@click.option("--verbose", "-v", is_flag=True, help="Show tracebacks of errors.")
@click.pass_context
def commands(context: click.Context, version: bool, verbose: bool) -> None:
    """Turn robot camera recordings into ordinary mp4 files, and back again exactly."""
    if verbose:
        os.environ[DEBUG] = "1"
    if version:
        say(f"mp4ds {__version__}")
        context.exit()
    if context.invoked_subcommand is None:
        click.echo(context.get_help(), err=True)
        context.exit(2)


def main() -> NoReturn:
    """Run the command line and exit."""
    prepare_process()
    code = exit_code_of(lambda: commands.main(sys.argv[1:]))
    # all is cleaned up: one more Ctrl-C while Python ends its threads would print a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(code)
