"""The command line: `trustbo demo`, `run`, `resume`, `report`, `export`, `study` and `worlds`."""

from trustbo.cli.program import app, main

__all__ = ["app", "main"]
