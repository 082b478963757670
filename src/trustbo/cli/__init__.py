"""The command line: `trustbo demo`, `run`, `resume`, `live`, `report`, `export`, `study`, ..."""

from trustbo.cli.program import app, main

__all__ = ["app", "main"]
