"""Commands, and options of dataclasses as their options."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import click

from mp4ds.cli.output import JSON, QUIET
from mp4ds.errors import OptionError
from mp4ds.options import LONG, PANELS, WHERE, Declared, Options, declared_in

_F = TypeVar("_F", bound=Callable[..., Any])
_COMMAND = "mp4ds.command"  # key in click's context: the one that runs
_METAVARS = {int: "N", float: "N", Path: "PATH"}


def _set_quiet(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    if value:
        ctx.meta[QUIET] = True


_FLAG: dict[str, Any] = {"is_flag": True, "expose_value": False}
_QUIET = _FLAG | {"callback": _set_quiet, "help": "Print nothing but errors and --json output."}
quiet_option = click.option("--quiet", "-q", **_QUIET)


class Argument(click.Argument):
    """An argument with a help text."""

    def __init__(self, *args: Any, help: str, **values: Any) -> None:  # noqa: A002
        super().__init__(*args, **values)
        self.text = help

    def get_usage_pieces(self, ctx: click.Context) -> list[str]:
        """The argument in the line of usage, in brackets if it may be left out."""
        words = self.make_metavar(ctx)
        return [words if self.required else f"[{words}]"]


class Option(click.Option):
    """An option in a panel of the help.

    Args:
        *args: As for click.
        panel: Its name.
        alone: What it means without one of its choices after it; empty where it takes any word.
        choices: These.
        **values: As for click.
    """

    def __init__(
        self,
        *args: Any,
        panel: str = "Options",
        alone: str = "",
        choices: Collection[str] = (),
        **values: Any,
    ) -> None:
        super().__init__(*args, **values)
        self.panel, self.alone, self.choices = panel, alone, choices

    def get_help_extra(self, ctx: click.Context) -> Any:
        """What follows the help text: no bounds."""
        extra: dict[str, Any] = dict(super().get_help_extra(ctx))
        extra.pop("range", None)
        return extra


class Command(click.Command):
    """A command with ``--quiet`` and ``--json``, whose help has its options in panels."""

    def __init__(self, *args: Any, **values: Any) -> None:
        super().__init__(*args, **values)
        self.params.append(Option(["--json"], help="Print the result as JSON.", **_FLAG))
        self.params.append(Option(["--quiet", "-q"], **_QUIET))

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments."""
        ctx.meta[_COMMAND] = self
        if "--json" in args:  # for errors of the others, too
            ctx.meta[JSON] = True
        return super().parse_args(ctx, self._completed(self.translated(ctx, args)))

    def _completed(self, words: list[str]) -> list[str]:
        """The words, in which an option that means something alone is not taken for half a pair."""
        alone = {
            flag: item
            for item in self.params
            if isinstance(item, Option) and item.alone
            for flag in item.opts
        }
        pairs = zip(words, [*words[1:], ""], strict=False)
        return [
            f"{word}={alone[word].alone}"
            if word in alone and following not in alone[word].choices
            else word
            for word, following in pairs
        ]

    def translated(self, ctx: click.Context, words: list[str]) -> list[str]:
        """The arguments as this command has them, of those that users type."""
        del ctx
        return words

    def panels(self, ctx: click.Context) -> dict[str, list[tuple[str, str, str]]]:
        """Name, words and help of arguments and options, by what they are about."""
        panels: dict[str, list[tuple[str, str, str]]] = {
            name: [] for name in ("Arguments", *PANELS, "Options")
        }
        for parameter in self.get_params(ctx):
            name = parameter.name or ""
            if isinstance(parameter, Argument):
                extra = "  [required]" if parameter.required else ""
                words = parameter.make_metavar(ctx)
                panels["Arguments"].append((name, words, parameter.text + extra))
            elif record := parameter.get_help_record(ctx):
                panel = getattr(parameter, "panel", "Options")
                panels[panel].append((name, record[0], self.in_flags(record[1])))
        return {panel: rows for panel, rows in panels.items() if rows}

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write arguments and options into their panels."""
        for panel, rows in self.panels(ctx).items():
            with formatter.section(panel):
                formatter.write_dl([row[1:] for row in rows])

    def in_flags(self, text: str) -> str:
        """A text with the fields in it, in backticks, replaced by flags."""
        flags = {
            item.name: next((flag for flag in item.opts if flag.startswith("--")), item.opts[0])
            for item in self.params
            if isinstance(item, click.Option)
        }
        return re.sub("`([a-z_0-9]+)`", lambda match: flags.get(match[1], match[0]), text)


def in_flags(text: str) -> str:
    """A sentence of the library, with options as the command that runs has them."""
    context = click.get_current_context(silent=True)
    command = context.meta.get(_COMMAND) if context else None
    return command.in_flags(text) if isinstance(command, Command) else text


# ---------------------------------------------------------------- declaring

command = partial(click.command, cls=Command)
option = partial(click.option, cls=Option)


def argument(name: str, metavar: str, help: str, **values: Any) -> Callable[[_F], _F]:  # noqa: A002
    """An argument of a command."""
    return click.argument(name, cls=Argument, metavar=metavar, help=help, **values)


jobs_option = option(
    "--jobs",
    "-j",
    metavar="N",
    panel=LONG,
    type=click.IntRange(1, 1024),
    help="Datasets to process in parallel; default: one per core.",
)


def output_option(metavar: str, help: str, **values: Any) -> Callable[[_F], _F]:  # noqa: A002
    """The option for where a command writes."""
    return option("--output", "-o", panel=WHERE, metavar=metavar, help=help, **values)


datasets_argument = argument(
    "datasets",
    "DATASET...",
    "Datasets or folders of datasets; or a sidecar next to its video.",
    nargs=-1,
    required=True,
)


def takes(
    kind: type[Options], name: str = "options", without: Collection[str] = ()
) -> Callable[[Callable[..., Any]], Any]:
    """Give a command the options of a dataclass, and its function an object of it.

    Args:
        kind: The dataclass.
        name: Of the function's parameter.
        without: Fields that have no meaning for the command.
    """
    fields = [
        (field, item)
        for field, item in declared_in(kind)
        if item.flags is not None and field not in without
    ]
    hints = get_type_hints(kind)

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def call(**given: Any) -> Any:
            values = {field: given.pop(field) for field, _ in fields}
            chosen = {field: value for field, value in values.items() if value not in (None, ())}
            return function(**given, **{name: kind(**chosen)})

        for field, item in reversed(fields):
            call = _option_of(field, item, hints[field], getattr(kind, field))(call)
        call.__dict__.setdefault("kinds", []).append(kind)  # for the documentation
        return call

    return decorate


def _option_of(field: str, declared: Declared, hint: Any, default: Any) -> Callable[[_F], _F]:
    """The command line's option for a field; without a value, the dataclass has its own."""
    base = next((part for part in get_args(hint) if part is not type(None)), hint)
    if get_origin(hint) is not None and type(None) not in get_args(hint):
        base = get_origin(hint)
    values: dict[str, Any] = {"metavar": declared.metavar or _METAVARS.get(base, "TEXT")}
    if declared.parse or base is str:
        values["type"] = str
        if declared.alone:
            values |= {"alone": declared.alone, "choices": declared.choices}
    elif base is bool:
        values = {"is_flag": True}
    elif base in (int, float):
        values["type"] = base
    elif base is Path:
        values["type"] = click.Path(path_type=Path)
    else:
        values |= {"type": str, "multiple": True}
    return option(
        field,
        *flags_of(field, declared),
        default=None,
        panel=declared.panel,
        help=declared.help + _default_text(declared, default),
        **values,
    )


def flags_of(field: str, declared: Declared) -> Sequence[str]:
    """The flags of an option, long ones before short ones."""
    flags = declared.flags or ()
    if any(flag.startswith("--") for flag in flags):
        return flags
    return ("--" + field.replace("_", "-"), *flags)


def _default_text(declared: Declared, default: Any) -> str:
    if default is None or default is False or default in ("", ()):
        return ""
    if default is True:
        default = (declared.flags or ("",))[0].partition("/")[0].lstrip("-")
    return f"  [default: {default:g}]" if isinstance(default, float) else f"  [default: {default}]"


def parse_share(text: str) -> tuple[int, int]:
    """Number and count of ``I/N``.

    Raises:
        OptionError: It is not valid.
    """
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise OptionError(f"`shard` {text!r} is not I/N with I from 1 to N, such as 3/16.")
    return int(match[1]), int(match[2])
