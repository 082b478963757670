"""Length and adaptation of a run of NUTS: names, defaults and limits."""

from collections.abc import Mapping
from numbers import Real
from typing import Any, NamedTuple, Self

from trustbo.errors import TrustboError, require_whole

_OF_ALL = ("n_chains", "draws")
"""Settings that the exact sampler takes too: the number and the shape of its draws."""


class NutsSettings(NamedTuple):
    """Length and adaptation of a NUTS run."""

    warmup: int = 300
    draws: int = 1000
    n_chains: int = 4
    target_accept: float = 0.9
    max_tree_depth: int = 10

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Self:
        """Settings by name, checked.

        Args:
            given: Values by name; None leaves a default.

        Raises:
            TrustboError: A number outside its range.
        """
        values = {name: value for name, value in given.items() if value is not None}
        settings = cls(**values)
        accept = settings.target_accept
        if not isinstance(accept, Real) or isinstance(accept, bool) or not 0.0 < accept < 1.0:
            raise TrustboError(f"target_accept must be between 0 and 1; got {accept!r}.")
        return settings._replace(
            warmup=require_whole("warmup", settings.warmup, 0),
            draws=require_whole("draws", settings.draws, 1),
            n_chains=require_whole("n_chains", settings.n_chains, 1),
            target_accept=float(accept),
            max_tree_depth=require_whole("max_tree_depth", settings.max_tree_depth, 1),
        )

    def require_sampler(self, sampler: str) -> None:
        """Refuse settings that are not the defaults where the exact sampler ignores them.

        Raises:
            TrustboError: A setting of NUTS alone, and another sampler.
        """
        changed = [n for n in SETTINGS if n not in _OF_ALL and getattr(self, n) != _DEFAULTS[n]]
        if sampler == "exact" and changed:
            raise TrustboError(
                f"{', '.join(changed)} {'is' if len(changed) == 1 else 'are'} for NUTS, and the "
                'sampler is "exact": give sampler "nuts", or leave '
                f"{'it' if len(changed) == 1 else 'them'}."
            )

    @property
    def shared(self) -> dict[str, int]:
        """Settings that every sampler takes."""
        return {name: getattr(self, name) for name in _OF_ALL}

    @property
    def longer(self) -> Self:
        """Settings of a longer run, after failed diagnostics."""
        return self._replace(
            warmup=2 * self.warmup,
            draws=2 * self.draws,
            target_accept=max(self.target_accept, 0.98),
        )

    def __str__(self) -> str:
        return f"{self.n_chains} chains of {self.warmup} + {self.draws} draws"


_DEFAULTS = NutsSettings._field_defaults
SETTINGS = ("n_chains", "warmup", "draws", "target_accept", "max_tree_depth")
"""Names of the settings that users give."""
