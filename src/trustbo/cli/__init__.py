"""The command line: `trustbo demo`, `info`, `run`, `resume`, `export`, `worlds`."""

from trustbo.cli.program import app, main

__all__ = ["app", "main"]
