"""The program `trustbo` and its commands; importing it imports nothing heavy."""

from collections.abc import Sequence
from typing import Annotated

import typer

from trustbo.cli.demo import demo
from trustbo.cli.export import export
from trustbo.cli.report import report
from trustbo.cli.resume import resume
from trustbo.cli.run import run
from trustbo.cli.study import study

EPILOG = """
Exit codes: 0 done; 1 done, but some of a study's runs failed; 2 bad input;
3 a posterior was refused, what was measured is kept; 130 interrupted.
"""
_PANELS = (
    ("A campaign", (demo, run, resume)),
    ("What it came to", (report, export)),
    ("Many campaigns", (study,)),
)

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["--help", "-h"]},
    epilog=EPILOG.strip(),
)
for panel, commands in _PANELS:
    for command in commands:
        app.command(rich_help_panel=panel, epilog=EPILOG.strip())(command)


def _show_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print(f"trustbo {version('trustbo')}")
        raise typer.Exit


@app.callback()
def _program(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Say which.")
    ] = False,
) -> None:
    """Learn how far robots can be trusted where, and plan the most trustworthy path.

    See it work:      trustbo demo
    On your terrain:  trustbo run --dem dem.tif --dsm dsm.tif --start 9,0 --goal 0,9
    How that works:   trustbo run --help
    """


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the program.

    Args:
        arguments: What would follow `trustbo` in a shell; by default what does.
    """
    app(arguments)
