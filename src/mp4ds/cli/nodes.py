"""Commands that run as ROS nodes, and accept ROS arguments from users and launch files."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from typing import Any

from mp4ds.cli.options import Command
from mp4ds.cli.output import be_quiet
from mp4ds.cli.process import DEBUG, report_errors
from mp4ds.errors import OptionError
from mp4ds.plugins.ros.names import PLAIN, NodeNames, node_arguments

_NAMES = "mp4ds.names"  # key of the ROS arguments in click's context
_QUIET = {"error", "fatal"}


class NodeCommand(Command):
    """A command that is a node: takes ``__name:=x``, ``--ros-args`` and the like."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments other than ROS arguments."""
        with report_errors("--json" in args):
            words, ctx.meta[_NAMES] = self.spelled(ctx, args)
        parsed: list[str] = super().parse_args(ctx, words)
        return parsed

    def valued(self, ctx: Any) -> set[str]:
        """Options that take a value."""
        return {
            name
            for option in self.get_params(ctx)
            if option.param_type_name == "option" and not getattr(option, "is_flag", False)
            for name in option.opts
        }

    def spelled(self, ctx: Any, args: Sequence[str]) -> tuple[list[str], NodeNames]:
        """The arguments of the command, and the ROS arguments.

        Raises:
            OptionError: A ROS argument is not valid.
        """
        del ctx
        return node_arguments(args, rules_of=())


def names_in(ctx: Any) -> NodeNames:
    """The ROS arguments of a command."""
    names: NodeNames = ctx.meta.get(_NAMES, PLAIN)
    return names


def say_as_much(level: str) -> None:
    """Set how much is printed, by a log level of ROS 2; empty: leave it.

    Raises:
        OptionError: There is no such level.
    """
    if level not in ("", "debug", "info", "warn", *_QUIET):
        raise OptionError(f"`log_level` {level!r} is not debug, info, warn, error or fatal.")
    if level == "debug":
        os.environ[DEBUG] = "1"
    if level in ("warn", *_QUIET):
        be_quiet()
    if level in _QUIET:
        warnings.simplefilter("ignore")
