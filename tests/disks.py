"""Disks on which files cannot be written."""

from contextlib import contextmanager

import pytest


@contextmanager
def full_disk():
    """Let this process write no file, as on a full disk; without rights to mount a disk."""
    resource = pytest.importorskip("resource")  # not on Windows
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
