"""The command line: `trustbo demo`, `run`, `resume`, `report`, `export`, `study`, ..."""

from trustbo.cli.program import app, main

__all__ = ["app", "main"]
