"""Effects as sample statements of NumPyro: their hyperparameters, and white coefficients."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from jax import Array
from jax.experimental.sparse import BCOO

from trustbo.models.effects.effect import Effect, Slots, dense_root, rest_of


def sampled_drift(
    effects: Sequence[Effect], slots: Slots, shape: tuple[int, int, int], memory: str = "level"
) -> Callable[[Array], Array]:
    """A function of beta0 that samples the drift by effects, shape (mission, bound, robot).

    Args:
        effects: Effects.
        slots: Rates by chain.
        shape: Missions, bounds and robots.
        memory: Memory of the model, see `PooledTrust`.
    """
    groups = [effect.group(slots) for effect in effects]
    columns = [BCOO.from_scipy_sparse(group.columns) for group in groups]
    slot = slots.mission[:, None], jnp.arange(slots.y.shape[1]), slots.robot[:, None]

    @jax.numpy_rank_promotion("allow")
    def drift(beta0: Array) -> Array:
        total = jnp.zeros(shape)
        for effect, group, U in zip(effects, groups, columns, strict=True):
            priors = effect.hyperpriors()
            theta: Any = {name: numpyro.sample(name, p) for name, p in priors.items()}
            theta = {name: value[None] for name, value in theta.items()}
            rest = rest_of(beta0[None], memory)
            prior = group.prior(theta | {"beta0": beta0[None], "rest": rest})
            white = dist.Normal(0.0, 1.0).expand((U.shape[1],)).to_event(1)
            c: Any = numpyro.sample(f"white_{'_'.join(priors)}", white)
            for joined, root in zip(group.joined, prior.roots, strict=True):
                c = c.at[joined].set(dense_root(root)[0] @ c[joined])
            u = U @ (prior.mean[0] + prior.sd[0] * c)
            total = total.at[slot].add(u.reshape(slots.y.shape))
        return total

    return drift
