"""Effects as sample statements of NumPyro: their hyperparameters, and white coefficients."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import Array
from jax.experimental.sparse import BCOO

from trustbo.models.effects.effect import Effect, Slots, dense_root, rest_of
from trustbo.models.params import Params


class SampledDrift:
    """A function of parameters that samples the drift by effects, (mission, bound, robot)."""

    def __init__(
        self,
        effects: Sequence[Effect],
        slots: Slots,
        shape: tuple[int, int, int],
        memory: str = "level",
    ) -> None:
        """Lay the columns out.

        Args:
            effects: Effects.
            slots: Rates by chain.
            shape: Missions, bounds and robots.
            memory: Memory of the model, see `PooledTrust`.
        """
        self._effects, self._shape, self._memory = tuple(effects), shape, memory
        self._groups = [effect.group(slots) for effect in effects]
        self._columns = [BCOO.from_scipy_sparse(group.columns) for group in self._groups]
        self._rates = slots.y.shape
        self._slot = slots.mission[:, None], np.arange(slots.y.shape[1]), slots.robot[:, None]

    @property
    def names(self) -> list[str]:
        """Names of the coefficients of each effect."""
        return [f"coefficients_{'_'.join(effect.names)}" for effect in self._effects]

    @jax.numpy_rank_promotion("allow")
    def __call__(self, params: Params) -> Array:
        """Sample statements of all effects, and their drift."""
        beta0, total = jnp.asarray(params.beta0)[None], jnp.zeros(self._shape)  # pyright: ignore
        rest = rest_of(beta0, self._memory)
        groups = zip(self._effects, self._groups, self._columns, self.names, strict=True)
        for effect, group, U, name in groups:
            priors = effect.hyperpriors()
            theta: Any = {name: numpyro.sample(name, p) for name, p in priors.items()}
            theta = {name: value[None] for name, value in theta.items()}
            prior = group.prior(theta | {"beta0": beta0, "rest": rest})
            white = dist.Normal(0.0, 1.0).expand((U.shape[1],)).to_event(1)
            c: Any = numpyro.sample(f"white_{'_'.join(priors)}", white)
            for joined, root in zip(group.joined, prior.roots, strict=True):
                c = c.at[joined].set(dense_root(root)[0] @ c[joined])
            c = numpyro.deterministic(name, prior.mean[0] + prior.sd[0] * c)
            total = total.at[self._slot].add((U @ c).reshape(self._rates))
        return total

    def named(
        self, draws: Mapping[str, np.ndarray], rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Effects by name, (draw, ...), of draws of hyperparameters and coefficients."""
        groups, found = zip(self._groups, self.names, strict=True), {}
        for group, name in groups:
            found |= group.name(draws[name], draws, rng)
        return found
