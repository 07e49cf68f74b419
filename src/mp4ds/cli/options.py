"""Options of dataclasses as command-line options, and values as users write them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from functools import update_wrapper
from typing import Annotated, Any, Optional, Union, get_args, get_origin, get_type_hints

import typer
import typer.core
from typer.models import OptionInfo

from mp4ds.cli.output import be_quiet
from mp4ds.errors import OptionError
from mp4ds.options import PANELS, Declared, Options, declared_in

DatasetArgument = Annotated[str, typer.Argument(help="A dataset, or a sidecar next to its video.")]
DatasetsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="DATASET...",
        help="Datasets or folders of datasets; or a sidecar next to its video.",
    ),
]
JobsOption = Annotated[
    Optional[int],  # noqa: UP045 - read at run time by typer
    typer.Option(
        "--jobs",
        "-j",
        min=1,
        max=1024,
        help="Datasets to process in parallel; default: one per core.",
    ),
]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
ForceFlag = Annotated[bool, typer.Option("--force", "-f", help="Replace an existing output.")]

QuietFlag = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print nothing but errors and --json output.")
]

_FLAGS: dict[str, str] = {}  # flags of the options of all commands built so far


def in_flags(text: str) -> str:
    """A sentence of the library, with option names replaced by command-line flags."""
    return re.sub("`([a-z_0-9]+)`", lambda match: _FLAGS.get(match[1], match[0]), text)


# ---------------------------------------------------------------- help

_TYPES = {"int": "N", "float": "N", "str": "TEXT", "path": "PATH"}
_NOT_A_NUMBER = {  # by the type of pydantic's error: typer shows its sentences
    "int_parsing": "{input!r} is not a whole number",
    "float_parsing": "{input!r} is not a number",
    "greater_than_equal": "{input} is below {ge:g}",
    "less_than_equal": "{input} is above {le:g}",
}
_EXTRAS = re.compile(r"(?:^|  )\[([^\]]*)\]$")


class Command(typer.core.TyperCommand):
    """A command whose help groups its options by topic, and that says what a number may be."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments."""
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            cause: Any = error.__cause__
            found: dict[str, Any] = cause.errors()[0] if hasattr(cause, "errors") else {}
            if found.get("type") in _NOT_A_NUMBER:
                text = _NOT_A_NUMBER[found["type"]]
                error.message = text.format(input=found["input"], **found.get("ctx", {}))
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The usage line, with arguments named as in the help."""
        del ctx
        names = [
            name if parameter.required else f"[{name}]"
            for parameter in self.params
            if (name := _argument(parameter))
        ]
        return ["[OPTIONS]", *names]

    def panels(self, ctx: Any) -> dict[str, list[tuple[str, str, str]]]:
        """Name, words and help of arguments and options, by what they are about."""
        panels: dict[str, list[tuple[str, str, str]]] = {
            name: [] for name in ("Arguments", *PANELS, "Options")
        }
        panels_of = {
            field: item.panel
            for kind in getattr(self.callback, "kinds", ())
            for field, item in declared_in(kind)
        }
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is None:
                continue
            name = _argument(parameter)
            panel = "Arguments" if name else panels_of.get(parameter.name or "", "Options")
            words = re.sub(
                "<([a-z]+)(?: range)?>", lambda match: _TYPES.get(match[1], "TEXT"), record[0]
            )
            text = _EXTRAS.sub(_without_bounds, record[1])
            panels[panel].append((parameter.name or "", name or words, text))
        return {panel: rows for panel, rows in panels.items() if rows}

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options into their panels."""
        for panel, rows in self.panels(ctx).items():
            with formatter.section(panel):
                formatter.write_dl([row[1:] for row in rows])


def _without_bounds(extras: re.Match[str]) -> str:
    """The bracketed part after a help text, without the bounds of numbers."""
    kept = [part for part in extras[1].split("; ") if not re.search(r"\bx[<>]=?", part)]
    return f"  [{'; '.join(kept)}]" if kept else ""


def _argument(parameter: Any) -> str:
    """Name of an argument; empty for an option."""
    if parameter.param_type_name != "argument":
        return ""
    name: str = parameter.metavar or parameter.name.upper()
    return name


# ---------------------------------------------------------------- options of dataclasses


def takes(*kinds: type[Options]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of dataclasses, after its own required ones.

    For each dataclass the command gets a function that builds it from the user's values and raises
    `OptionError` for invalid ones.

    Args:
        kinds: The dataclasses; no two have an option of the same name.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(command, include_extras=True)
        written = list(inspect.signature(command).parameters.values())[len(kinds) :]
        own = [one.replace(annotation=_annotated(hints[one.name])) for one in written]
        for parameter in own:
            for info in get_args(parameter.annotation)[1:]:
                if isinstance(info, OptionInfo):
                    # typer takes the first one for the default, where it is to be a hint
                    told = (info.default, *(info.param_decls or ()), f"--{parameter.name}")
                    flag = next(str(one) for one in told if str(one).startswith("--"))
                    _FLAGS[parameter.name] = flag.partition("/")[0]
        for kind in kinds:
            for name, item in declared_in(kind):
                _FLAGS[name] = flags_of(name, item)[0].partition("/")[0]
        made = [_parameters(kind) for kind in kinds]
        required = [parameter for parameter in own if parameter.default is parameter.empty]
        others = [parameter for parameter in own if parameter.default is not parameter.empty]
        parameters = [*required, *(one for found in made for one in found.values()), *others]

        def call(**given: Any) -> None:
            values = [{name: given.pop(name) for name in found} for found in made]
            command(
                *(
                    lambda kind=kind, value=value: _made(kind, value)
                    for kind, value in zip(kinds, values, strict=True)
                ),
                **given,
            )

        call.__dict__["kinds"] = kinds  # for the documentation
        return _signed(call, command, parameters)

    return decorate


def quietable(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the option ``--quiet``, which may also stand before the command."""
    hints = get_type_hints(command, include_extras=True)
    own = [
        parameter.replace(annotation=_annotated(hints[name]), kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in inspect.signature(command).parameters.items()
    ]
    if "quiet" in hints:
        return command

    def call(quiet: bool, **given: Any) -> None:
        if quiet:
            be_quiet()
        command(**given)

    quiet = inspect.Parameter(
        "quiet", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=QuietFlag
    )
    return _signed(call, command, [*own, quiet])


def _signed(
    call: Callable[..., None],
    command: Callable[..., None],
    parameters: Sequence[inspect.Parameter],
) -> Callable[..., None]:
    """A function that calls a command, with the parameters that typer is to see."""
    update_wrapper(call, command)
    del call.__dict__["__wrapped__"]  # typer would follow it
    call.__dict__["__signature__"] = inspect.Signature(
        [parameter.replace(kind=parameter.KEYWORD_ONLY) for parameter in parameters]
    )
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return call


def _annotated(hint: Any) -> Any:
    """A hint with its option outermost; Python 3.10 makes it optional where the default is None."""
    return next((part for part in get_args(hint) if get_origin(part) is Annotated), hint)


def _parameters(kind: type[Options]) -> Mapping[str, inspect.Parameter]:
    hints = get_type_hints(kind)
    return {
        name: _parameter(name, hints[name], getattr(kind, name), item)
        for name, item in declared_in(kind)
        if item.flags is not None
    }


def _parameter(name: str, hint: Any, default: Any, shown: Declared) -> inspect.Parameter:
    if shown.parse or default == ():
        default = default or None
    info = typer.Option(
        *flags_of(name, shown),
        help=in_flags(shown.help),
        metavar=shown.metavar,
        min=shown.least,
        max=shown.most,
    )
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[_plain(hint, shown), info],
    )


def flags_of(name: str, shown: Declared) -> Sequence[str]:
    """The flags of an option, long ones before short ones."""
    flags = shown.flags or ()
    has_long = any(flag.startswith("--") for flag in flags)
    return flags if has_long else ("--" + name.replace("_", "-"), *flags)


def _plain(hint: Any, shown: Declared) -> Any:
    """A type that typer can parse."""
    if shown.parse:
        return Optional[str]  # noqa: UP045
    if get_origin(hint) not in (None, Union) and type(None) not in get_args(hint):
        return Optional[list[str]]  # noqa: UP045 - of a sequence
    if type(None) in get_args(hint):  # with a bar, which old typers cannot read
        return Optional[get_args(hint)[0]]  # noqa: UP045
    return hint


def _made(kind: type[Options], given: Mapping[str, Any]) -> Options:
    return kind(**{name: value for name, value in given.items() if value is not None})


def cores(jobs: int | None) -> int:
    """Number of processes: as requested, or one per core."""
    if jobs is not None:
        return jobs
    from mp4ds.packing.planning import available_cores

    return available_cores()


def parse_share(text: str) -> tuple[int, int]:
    """Number and count of ``I/N``.

    Raises:
        OptionError: It is not valid.
    """
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise OptionError(f"`shard` {text!r} is not I/N with I from 1 to N, such as 3/16.")
    return int(match[1]), int(match[2])
