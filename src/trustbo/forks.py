"""Refusal of JAX in a process that was forked after JAX had started its threads."""

import os
import sys

from trustbo.errors import TrustboError

_lost_threads = False
"""Whether this process is such a fork."""


def require_threads_of_jax() -> None:
    """Raise TrustboError if JAX would wait for threads that exist only in the parent process."""
    if _lost_threads:
        raise TrustboError(
            "this process was made by fork after JAX had computed in its parent, and JAX cannot "
            "compute here, because threads are not forked; start processes with "
            'multiprocessing.get_context("spawn") or "forkserver", or with joblib\'s default loky.'
        )


def _note_fork() -> None:
    """Note in a forked process whether JAX was running in its parent.

    JAX has no public function that tells this without starting its threads. If a later version
    renames the attribute, every fork of a process that imported JAX counts.
    """
    global _lost_threads
    bridge = sys.modules.get("jax._src.xla_bridge")
    _lost_threads = _lost_threads or bool(getattr(bridge, "_backends", "jax" in sys.modules))


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_note_fork)
