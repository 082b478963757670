"""The program `trustbo` and its commands; importing it imports nothing heavy."""

import gc
import sys
from collections.abc import Sequence
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from trustbo.cli.campaigns import demo, resume, run
from trustbo.cli.errors import BAD_INPUT, complain
from trustbo.cli.options import with_flags
from trustbo.cli.results import export
from trustbo.cli.studies import worlds
from trustbo.cli.terrains import info

EPILOG = """
Exit codes: 0 done; 1 done, but some runs failed, or an unforeseen
error (with a traceback); 2 bad input; 3 a posterior was refused,
measured missions are kept; 130 interrupted.
"""
_UsageError: Any = typer.BadParameter.__mro__[1]  # click's, wherever typer keeps it
_PANELS = {
    "Campaigns": {demo: "out", info: "", run: "out", resume: "folder"},
    "Results": {export: ""},
    "Studies": {worlds: ""},
}
"""Commands by panel, and the parameter with the folder of the campaign that a command works on."""


class _PlainFlags:
    """Help of a command without the type of flags that take no value, which Typer calls <bool>."""

    def get_params(self, ctx: Any) -> list[Any]:
        params = super().get_params(ctx)  # pyright: ignore[reportAttributeAccessIssue]
        for param in params:
            if getattr(param, "is_flag", False):
                param.metavar = ""
        return params


class _Command(_PlainFlags, TyperCommand):
    pass


class _Program(_PlainFlags, TyperGroup):
    pass


app = typer.Typer(
    cls=_Program,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["--help", "-h"]},
    epilog=EPILOG.strip(),
)
for panel, commands in _PANELS.items():
    for command, folder in commands.items():
        kept = {"cls": _Command, "rich_help_panel": panel, "epilog": EPILOG.strip()}
        app.command(**kept)(with_flags(command, folder))


def _show_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print(f"trustbo {version('trustbo')}")
        raise typer.Exit


@app.callback()
def _program(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Learn the trust in robots on a terrain, and plan the most trustworthy path.

    On a real hillside:      trustbo demo
    The grid of a terrain:   trustbo info dem.tif dsm.tif
    On a terrain of yours:   trustbo run --dem dem.tif --dsm dsm.tif --start 9,0 --goal 0,9
    All flags:               trustbo run --help
    """


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the program on the words after `trustbo` in a shell, and exit with its code.

    By default those of this process; misuse is one line and a hint.
    """
    gc.set_threshold(100_000)  # a demo spends a second less on cycles, in no more memory
    given = sys.argv[1:] if arguments is None else list(arguments)
    try:
        code = app(given or ["--help"], prog_name="trustbo", standalone_mode=False)
    except _UsageError as error:
        where = getattr(error, "ctx", None)
        name = where.command_path if where else "trustbo"
        reason = _missing(error) or _unknown_option(error) or _no_number(error)
        complain(reason or str(error.format_message()), f"{name} --help lists commands and flags.")
        sys.exit(BAD_INPUT)
    sys.exit(code or 0)


def _missing(error: Any) -> str:
    """Name all required options that are missing, not only the first, which the error names."""
    if not hasattr(error, "param_type") or error.ctx is None:
        return ""
    given = error.ctx.params
    lacking = [
        option.metavar if option.param_type_name == "argument" else option.opts[0]
        for option in error.ctx.command.params
        if option.required and given.get(option.name) is None
    ]
    kind = "argument" if any(not name.startswith("-") for name in lacking) else "option"
    return f"missing {kind}{'s' * (len(lacking) > 1)} {', '.join(lacking)}."


def _unknown_option(error: Any) -> str:
    """Name the option nearest to an unknown one; for other errors, nothing."""
    near = getattr(error, "possibilities", None)  # the nearest first
    if near is None or not hasattr(error, "option_name"):
        return ""
    typed, context = error.option_name, error.ctx
    if context is not None:
        params = context.command.params
        places = {p.name: p.metavar for p in params if p.param_type_name == "argument"}
        if typed[2:] in places or (typed == "--out" and "folder" in places):
            alone = " ".join((context.command_path, *places.values()))
            return f"unknown option {typed}; give it without a flag: {alone}"
    swapped = [name for name in near if sorted(name) == sorted(typed)]  # the usual slip
    advice = f"; did you mean {(swapped or near)[0]}?" if near else "."
    return f"unknown option {typed}{advice}"


def _no_number(error: Any) -> str:
    """Name the flag and its value where a number was to be given; else nothing."""
    param, message = getattr(error, "param", None), str(getattr(error, "message", ""))
    return (
        f"{param.opts[0]} {message}" if param is not None and message.startswith("must be ") else ""
    )
