"""Refusal of plates that take a subset of their data, which a fit would not change."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from numpyro.primitives import Messenger

from trustbo.errors import TrustboError


class WholePlates(Messenger):
    """Handler that raises a TrustboError for a plate with `subsample_size` below its size.

    NumPyro draws such a subset once in each run of a function. NUTS needs one density, so all of
    its runs would use the same subset, and the rest of the data would have no effect. Loops and
    branches of `numpyro.contrib.control_flow` hide their plates from handlers that are outside, so
    the handler also enters them.
    """

    def __init__(self, fn: Callable[..., Any] | None = None, *, owner: str) -> None:
        """Set the function to run and its name in messages."""
        self.owner = owner
        super().__init__(fn)

    def process_message(self, msg: Any) -> None:
        """Enter the functions of a loop or a branch."""
        if msg["type"] == "control_flow":
            msg["args"] = tuple(
                self._entering(one) if _is_function(one) else one for one in msg["args"]
            )

    def postprocess_message(self, msg: Any) -> None:
        """Raise TrustboError if a plate has fewer indices than its size."""
        if msg["type"] != "plate":
            return

        size = msg["args"][0]
        n_chosen = np.shape(msg["value"])[0]
        if n_chosen != size:
            raise TrustboError(
                f"the plate {msg['name']!r} of {self.owner} takes a subset of {n_chosen} of its "
                f"{size} entries (subsample_size), which would be the same in the whole fit; leave "
                "out subsample_size, so that all entries are used."
            )

    def _entering(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function of a loop or a branch that runs within this handler."""

        def run(*arguments: Any) -> Any:
            with WholePlates(owner=self.owner):
                return function(*arguments)

        return run


def _is_function(value: Any) -> bool:
    """Return whether a value is a function, and not data such as a network that can be called."""
    return callable(value) and jax.tree_util.all_leaves([value])
