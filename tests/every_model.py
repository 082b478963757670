"""Every model with every effect, observations for them, and parameters of every kind."""

from itertools import product

import numpy as np

from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    PlaceEffect,
    PooledTrust,
    RobotEffect,
    TrustParams,
)
from trustbo.models.observations import Observations
from trustbo.models.visited import visited

FEATURES = ("line_of_sight", "vegetation")
GRID = (4, 4)
N_TICKS = 50
_EFFECTS = {
    (): "",
    (PlaceEffect(),): ", places",
    (RobotEffect(),): ", robots",
    (PlaceEffect(), RobotEffect()): ", places and robots",
}


def models_of(family):
    """Every model of an observation family with every effect, by name."""
    options = {"effects": list(_EFFECTS), "memory": ["level", "deviation"]}
    if family != "beta_binomial":  # whose rates have no noise to share
        options["shared_noise"] = [False, True]

    found = {}
    for values in product(*options.values()):
        given = dict(zip(options, values, strict=True))
        name = ", deviation" * (given["memory"] == "deviation")
        name += ", shared noise" * given.get("shared_noise", False) + _EFFECTS[given["effects"]]
        found[f"pooled{name}"] = PooledTrust(family=family, **given)
        found[f"hierarchical{name}"] = HierarchicalTrust(family=family, **given)
    for effects, name in _EFFECTS.items():
        found[f"coupled{name}"] = CoupledTrust(family=family, effects=effects)
    return found


def observed(*, gaps=False, shape=(4, 5, 3), with_places=True):
    """Observations that no model has drawn, and moves, rows and columns (mission, bound, 3)."""
    rng = np.random.default_rng(0)
    z, y = rng.uniform(size=(*shape, 2)), rng.uniform(size=shape)
    if gaps:
        y[rng.random(shape) < 0.15] = np.nan
        y[1, 3:] = np.nan
    bounds = np.stack([rng.integers(0, n, shape[:2]) for n in (8, *GRID)], axis=-1)
    places = visited(bounds, GRID) if with_places else None
    return Observations(y, z, np.full(shape, float(N_TICKS)), FEATURES, places), bounds


def draws_of(kind, *, n_draws=3, n_robots=3, shape=GRID, seed=0):
    """Draws of parameters of a kind of `KINDS`, whose trust stays near .5."""
    rng = np.random.default_rng(seed)
    model, *words = kind.split(", ")
    beta0 = rng.uniform(0.2, 0.8, n_draws)
    x0 = rng.uniform(0.4, 0.6, n_draws), rng.uniform(0.05, 0.2, n_draws)
    places = {}
    if "places" in words:
        n = 1 if model == "pooled" else n_robots
        places["place"] = 0.03 * rng.normal(size=(n_draws, n, *shape))
        places["place_bound"] = 0.03 * rng.normal(size=(n_draws, n, 8, *shape))

    if model == "coupled":
        B0 = rng.uniform(0.0, 0.1, (n_draws, n_robots, n_robots))
        B0 += 0.3 * np.eye(n_robots)
        B = 0.05 * rng.normal(size=(n_draws, 2, n_robots, n_robots))
        root_w, root_v = 0.06 * rng.normal(size=(2, n_draws, n_robots, n_robots))
        own = 0.005 * np.eye(n_robots)
        b = rng.uniform(0.2, 0.3, (n_draws, n_robots))
        noises = {"Delta_w": root_w @ root_w.mT + own, "Delta_v": root_v @ root_v.mT + own}
        return TrustParams(B0=B0, B=B, b=b, **noises, x0_mean=x0[0], x0_sd=x0[1], **places)

    memory = "deviation" if "deviation" in words else "level"
    gain = 1.0 if memory == "deviation" else 1.0 - beta0
    beta = rng.uniform(0.0, 0.25, (n_draws, 2))
    noises = rng.uniform(0.05, 0.2, (2, n_draws))
    options = {"memory": memory, **places}
    if "shared noise" in words:
        options["delta_s"] = rng.uniform(0.05, 0.2, n_draws)
    if model == "pooled":
        scaled = (gain * beta.T).T, 0.3 * gain * np.ones(n_draws)
        return TrustParams(beta0, *scaled, *noises, *x0, **options)

    beta0 = rng.uniform(0.2, 0.8, (n_draws, n_robots))
    gain = np.ones_like(beta0) if memory == "deviation" else 1.0 - beta0
    beta = gain[..., None] * rng.uniform(0.0, 0.25, (n_draws, n_robots, 2))
    noises = rng.uniform(0.05, 0.2, (2, n_draws, n_robots))
    return TrustParams(beta0, beta, 0.3 * gain, *noises, *x0, per_robot=True, **options)


KINDS = [
    f"{model}{memory}{noise}{places}"
    for model, memory, noise, places in product(
        ("pooled", "robots"), ("", ", deviation"), ("", ", shared noise"), ("", ", places")
    )
] + ["coupled", "coupled, places"]
"""Kinds of parameters: the model, what lasts, and whether there are shared noise and places."""
