"""The joint distribution of contact rates for numpyro, and compiled functions of it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax import Array, lax
from numpyro.distributions import constraints

from trustbo.models.families import FAMILIES, Family, Observed
from trustbo.models.params import Params

_BATCH = 256  # draws computed at once


class ModelRates(dist.Distribution):
    """Joint distribution of a batch of missions' contact rates under a trust model.

    Batch shape (mission,), event shape (bound, robot). A rate that is NaN counts as not measured.
    Latent trust is integrated out where its family allows; else `log_prob` is a weight that depends
    on `innovations` and averages to the density (see `families.family`).
    """

    support = constraints.independent(constraints.real, 2)  # pyright: ignore
    pytree_data_fields = ("params", "awareness", "n_ticks", "innovations")
    pytree_aux_fields = ("observation",)

    def __init__(
        self,
        params: Params,
        awareness: Array,
        *,
        n_ticks: Array | None = None,
        innovations: Array | None = None,
        observation: str = "gaussian",
    ) -> None:
        """Take parameters and awareness.

        Args:
            params: Parameters without leading axes.
            awareness: Shape (mission, bound, robot, feature).
            n_ticks: Ticks, shape (mission, bound, robot); the beta-binomial family needs them.
            innovations: Standard normal numbers that latent trust is a function of where it does
                not integrate out, shape (bound, mission, robot); 0 by default.
            observation: Name of the family, such as `"gaussian"`.
        """
        self.params, self.awareness, self.n_ticks = params, awareness, n_ticks
        self.innovations, self.observation = innovations, observation
        super().__init__(awareness.shape[:1], awareness.shape[1:3])

    @property
    def family(self) -> Family:
        """The family of observations."""
        return FAMILIES[self.observation]

    def log_prob(self, value: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Log density in nats, shape (mission,)."""
        observed = Observed.of(value, self.n_ticks)
        innovations = self.innovations
        innovations = jnp.zeros_like(observed.y) if innovations is None else innovations
        ssm = self.params.ssm(self.awareness)
        return self.family.log_density(ssm, observed, innovations).sum(1)

    def sample(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: Array, sample_shape: tuple[int, ...] = ()
    ) -> Array:
        """Contact rates, shape `(*sample_shape, mission, bound, robot)`."""
        ssm = self.params.ssm(self.awareness)
        ticks = jnp.full(self.event_shape, jnp.nan) if self.n_ticks is None else self.n_ticks
        ticks = jnp.broadcast_to(ticks, self.awareness.shape[:3])

        def one(key: Array) -> Array:
            key_trust, key_rate = jax.random.split(key)
            trust, y = ssm.simulate(key_trust)
            rates = self.family.measure(key_rate, ssm, trust, y, jnp.swapaxes(ticks, 0, 1))
            return jnp.swapaxes(rates, 0, 1)

        for _ in sample_shape:
            one = jax.vmap(one)
        return one(jax.random.split(key, sample_shape))


@partial(jax.jit, static_argnames=("family",))
def mission_log_likelihood(
    family: Family,
    params: Params,
    awareness: Array,
    contact_rate: Array,
    n_ticks: Array,
    key: Array,
) -> Array:
    """Log p(contact rates of each mission | draw), latent trust integrated out; (draw, mission)."""

    def one(p: Params) -> Array:
        observed = Observed.of(contact_rate, n_ticks)
        # The same innovations for every draw: common random numbers.
        return family.marginal_log_likelihood(p.ssm(awareness), observed, key)

    n_draws = len(params.b)
    if n_draws < _BATCH:
        return jax.vmap(one)(params)
    # Whole batches: a shorter last one would be compiled separately.
    rows = np.minimum(np.arange(-(-n_draws // _BATCH) * _BATCH), n_draws - 1)
    return lax.map(one, jax.tree.map(lambda a: a[rows], params), batch_size=_BATCH)[:n_draws]
