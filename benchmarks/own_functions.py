"""NumPyro functions of the kinds that researchers write, on which samplers are compared.

They are models of missions in the terrain example, whose third feature is line of sight. All of
them are in `FUNCTIONS`, by name.
"""

import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from numpyro.contrib.hsgp.approximation import hsgp_squared_exponential

from trustbo.models import (
    ContactRate,
    CoupledTrust,
    HierarchicalTrust,
    PlaceEffect,
    PooledTrust,
    Priors,
    RobotEffect,
)

SIGHT = 2  # index of line of sight among the features
N_UNITS = 4  # hidden units of the neural network
HALF = 4.5  # half the distance between the first and the last of ten cells


def noises(scale=0.1):
    delta_w = numpyro.sample("delta_w", dist.HalfNormal(scale))
    delta_v = numpyro.sample("delta_v", dist.HalfNormal(scale))
    return delta_w, delta_v


def observed(drift, beta0, delta_w, delta_v, contact_rate, n_ticks, **others):
    with numpyro.plate("mission", len(drift)):
        rates = ContactRate(drift, beta0, delta_w, delta_v, n_ticks=n_ticks, **others)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def four(awareness, contact_rate=None, n_ticks=None):
    """Four variables, and a drift that is a product of two of them."""
    weight = numpyro.sample("weight", dist.Normal(1.0, 0.3))
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 4.0))
    delta_w = numpyro.sample("delta_w", dist.LogNormal(-3.0, 0.5))
    delta_v = numpyro.sample("delta_v", dist.LogNormal(-3.0, 0.5))

    drift = (1.0 - beta0) * weight * awareness[..., SIGHT]
    observed(drift, beta0, delta_w, delta_v, contact_rate, n_ticks)


def saturating(awareness, contact_rate=None, n_ticks=None):
    """A drift that saturates in line of sight."""
    level = numpyro.sample("level", dist.Normal(0.1, 0.2))
    most = numpyro.sample("most", dist.HalfNormal(0.5))
    rise = numpyro.sample("rise", dist.LogNormal(1.0, 0.5))
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))

    drift = level + most * (1.0 - jnp.exp(-rise * awareness[..., SIGHT]))
    observed(drift, beta0, *noises(), contact_rate, n_ticks)


def weights_by_robot(awareness, contact_rate=None, n_ticks=None):
    """Hierarchical weights of the features for each robot, in the centred parametrisation."""
    n_robots, n_features = awareness.shape[2:]
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    mean = numpyro.sample("mean", dist.Normal(0.2, 0.3).expand([n_features]).to_event(1))
    sd = numpyro.sample("sd", dist.HalfNormal(0.2))
    with numpyro.plate("robot", n_robots):
        weight = numpyro.sample("weight", dist.Normal(mean, sd).to_event(1))

    drift = jnp.einsum("mbrf,rf->mbr", awareness, weight)
    observed(drift, beta0, *noises(), contact_rate, n_ticks)


def hierarchical(awareness, contact_rate=None, n_ticks=None):
    """Levels of robots and of missions, with both scales unknown."""
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    weight = numpyro.sample("weight", dist.Normal(0.3, 0.3))
    middle = numpyro.sample("middle", dist.Normal(0.1, 0.2))
    spread = numpyro.sample("spread", dist.HalfNormal(0.1))
    tau = numpyro.sample("tau", dist.HalfNormal(0.1))
    with numpyro.plate("robot", awareness.shape[2]):
        level = numpyro.sample("level", dist.Normal(middle, spread))
    delta_w, delta_v = noises()

    with numpyro.plate("mission", len(awareness)):
        day = numpyro.sample("day", dist.Normal(0.0, tau))
        drift = level + weight * awareness[..., SIGHT] + day[:, None, None]
        rates = ContactRate(drift, beta0, delta_w, delta_v, n_ticks=n_ticks)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def heavy_tailed(awareness, contact_rate=None, n_ticks=None):
    """Priors with heavy tails."""
    n_robots, n_features = awareness.shape[2:]
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    size = numpyro.sample("size", dist.HalfCauchy(0.2))
    weight = numpyro.sample("weight", dist.StudentT(2.0, 0.0, 0.3).expand([n_features]).to_event(1))
    with numpyro.plate("robot", n_robots):
        level = numpyro.sample("level", dist.StudentT(3.0, 0.2, size))
    observed(level + awareness @ weight, beta0, *noises(), contact_rate, n_ticks)


def coupled(awareness, contact_rate=None, n_ticks=None):
    """A matrix beta0, by which robots influence each other."""
    n = awareness.shape[2]
    own = numpyro.sample("own", dist.Beta(2.0, 2.0))
    other = numpyro.sample("other", dist.Normal(0.0, 0.1).expand([n, n]).to_event(2))
    level = numpyro.sample("level", dist.Normal(0.1, 0.2))
    weight = numpyro.sample("weight", dist.Normal(0.3, 0.3))

    beta0 = own * jnp.eye(n) + other * (1.0 - jnp.eye(n))
    drift = level + weight * awareness[..., SIGHT]
    observed(drift, beta0, *noises(), contact_rate, n_ticks)


def ridge(awareness, contact_rate=None, n_ticks=None):
    """A beta0 near 0, so that the data hardly tell the two noises apart."""
    beta0 = numpyro.sample("beta0", dist.Beta(1.0, 12.0))
    level = numpyro.sample("level", dist.Normal(0.3, 0.3))
    weight = numpyro.sample("weight", dist.Normal(0.3, 0.3))
    observed(level + weight * awareness[..., SIGHT], beta0, *noises(), contact_rate, n_ticks)


def ridge_by_robot(awareness, contact_rate=None, n_ticks=None):
    """The same with noises of each robot."""
    beta0 = numpyro.sample("beta0", dist.Beta(1.0, 12.0))
    level = numpyro.sample("level", dist.Normal(0.3, 0.3))
    weight = numpyro.sample("weight", dist.Normal(0.3, 0.3))
    with numpyro.plate("robot", awareness.shape[2]):
        delta_w, delta_v = noises()
    drift = level + weight * awareness[..., SIGHT]
    observed(drift, beta0, delta_w, delta_v, contact_rate, n_ticks)


def two_modes(awareness, contact_rate=None, n_ticks=None):
    """A weight that is a square, so that its root has two modes of different masses."""
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    level = numpyro.sample("level", dist.Normal(0.1, 0.2))
    root = numpyro.sample("root", dist.Normal(0.15, 0.7))
    drift = level + root**2 * awareness[..., SIGHT]
    observed(drift, beta0, *noises(), contact_rate, n_ticks)


def shared_noise(awareness, contact_rate=None, n_ticks=None):
    """A third noise, which all robots share."""
    level = numpyro.sample("level", dist.Normal(0.1, 0.2))
    weight = numpyro.sample("weight", dist.Normal(0.3, 0.3))
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    delta_s = numpyro.sample("delta_s", dist.HalfNormal(0.1))
    drift = level + weight * awareness[..., SIGHT]
    observed(drift, beta0, *noises(), contact_rate, n_ticks, delta_s=delta_s)


def hsgp(awareness, cell, contact_rate=None, n_ticks=None):
    """A Gaussian process over a grid of ten cells by ten, by basis functions."""
    level = numpyro.sample("level", dist.Normal(0.1, 0.2))
    weight = numpyro.sample("weight", dist.Normal(0.3, 0.3))
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    size = numpyro.sample("size", dist.HalfNormal(0.2))
    length = numpyro.sample("length", dist.LogNormal(0.0, 0.4))

    place = jnp.where(cell < 0, 0, cell) / HALF - 1.0
    flat = place.reshape(-1, 2)
    f = hsgp_squared_exponential(flat, size, length, ell=[1.5, 1.5], m=[5, 5])
    drift = level + weight * awareness[..., SIGHT] + f.reshape(place.shape[:2])[..., None]
    observed(drift, beta0, *noises(), contact_rate, n_ticks)


def neural(awareness, contact_rate=None, n_ticks=None):
    """A neural network, whose units can be exchanged."""
    n_features = awareness.shape[-1]
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    w1 = numpyro.sample("w1", dist.Normal(0.0, 1.0).expand([n_features, N_UNITS]).to_event(2))
    b1 = numpyro.sample("b1", dist.Normal(0.0, 1.0).expand([N_UNITS]).to_event(1))
    w2 = numpyro.sample("w2", dist.Normal(0.0, 0.3).expand([N_UNITS]).to_event(1))
    level = numpyro.sample("level", dist.Normal(0.3, 0.3))
    drift = level + jnp.tanh(awareness @ w1 + b1) @ w2
    observed(drift, beta0, *noises(), contact_rate, n_ticks)


def as_default(awareness, features, contact_rate=None, n_ticks=None):
    """The default model, with its priors, effects of places and effects of robots."""
    priors = Priors.from_features(tuple(features))
    beta0 = numpyro.sample("beta0", priors.beta0)
    delta_w = numpyro.sample("delta_w", priors.delta_w)
    delta_v = numpyro.sample("delta_v", priors.delta_v)
    mean, sd = priors.coefficients(len(features))
    c = numpyro.sample("c", dist.Normal(mean, sd).to_event(1))

    drift = (1.0 - beta0) * (awareness @ c[:-1] + c[-1])
    effects = [PlaceEffect().sample(), RobotEffect().sample()]
    start = {"x0_mean": priors.x0_mean, "x0_sd": priors.x0_sd}
    observed(drift, beta0, delta_w, delta_v, contact_rate, n_ticks, effects=effects, **start)


FUNCTIONS = {
    "four": four,
    "saturating": saturating,
    "weights_by_robot": weights_by_robot,
    "hierarchical": hierarchical,
    "heavy_tailed": heavy_tailed,
    "coupled": coupled,
    "ridge": ridge,
    "ridge_by_robot": ridge_by_robot,
    "two_modes": two_modes,
    "shared_noise": shared_noise,
    "hsgp": hsgp,
    "neural": neural,
    "pooled": PooledTrust().program,
    "hierarchical_class": HierarchicalTrust().program,
    "coupled_class": CoupledTrust().program,
}
