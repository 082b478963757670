"""Calls of commands, as from a shell."""

import pytest

from trustbo.cli import main


def call(*words):
    """Exit code of a command."""
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return ended.value.code
