"""Contact of the robots that take part, and the time in which several of them see the lead.

Let p_i be the contact rate of robot i in a bound. The rates do not determine how often nobody has
contact, because robots may lose the lead at the same time, such as behind a ridge. Contact at one
tick is therefore modelled as a mixture. With weight w, the robots lose the lead in order of their
rates, so at least k of them have contact with the probability of the k-th largest rate. With weight
1 - w, they have contact independently:

    P(at least k) = w p_(k) + (1 - w) P(sum_i B_i >= k),    B_i ~ Bernoulli(p_i).

The weight, called the dependence, is estimated from contact at ticks by least squares. Shares of
bounds with few robots or few ticks say little about it, so it is shrunk towards `USUAL`, as if
there were further bounds (ridge regression).

Rates of different robots in one bound also depend on each other before they are known: all have the
effect of the place and the noise that robots share. The draws of rates contain this dependence.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from trustbo.arrays import as_array
from trustbo.data import Mission, Station, require_unit_interval
from trustbo.errors import TrustboError, require_finite
from trustbo.models.draws import Draws
from trustbo.planning.problem import Problem
from trustbo.stacking import list_of_missions
from trustbo.statespace import Inputs, kalman
from trustbo.streams import stream

USUAL = 0.4
"""Dependence before any ticks were recorded: the mean of nine simulated worlds, .09 to .70."""
_AS_KNOWN = 0.02
"""Weight of `USUAL`, in units of the squared difference between dependent and independent robots;
four bounds of three robots have this weight."""
_TICKS = 200.0
"""Number of ticks assumed for a future bound."""
_FEWEST = 1000
"""Number of draws of rates; fewer draws of parameters are repeated."""


def at_least(rates: ArrayLike, dependence: float = USUAL) -> np.ndarray:
    """Compute the probability that at least 1, 2, ... robots have contact at a tick.

    Args:
        rates: Contact rates of the robots in a bound, shape (..., robot), in [0, 1].
        dependence: Weight of robots that lose the lead at the same time, in [0, 1]; the others are
            independent.

    Returns:
        Probabilities of at least 1, 2, ..., n contacts, shape (..., robot).

    Raises:
        TrustboError: A rate or the dependence is not in [0, 1].

    Example:
        >>> tb.planning.at_least([0.5, 0.5], dependence=0.0).tolist()
        [0.75, 0.25]
        >>> tb.planning.at_least([0.5, 0.5], dependence=1.0).tolist()
        [0.5, 0.5]
    """
    p = require_unit_interval("rates", as_array("rates", rates))
    w = require_finite("dependence", dependence)
    if not p.ndim or np.isnan(p).any():
        raise TrustboError("rates must have the axis (robot,) and no NaN; leave out other robots.")
    if not 0.0 <= w <= 1.0:
        raise TrustboError(f"dependence must be in [0, 1]; got {w:g}.")
    return w * _together(p) + (1.0 - w) * _apart(p)


def contact_dependence(missions: Iterable[Mission]) -> float:
    """Estimate how strongly robots lose contact at the same time, from ticks of missions.

    Args:
        missions: Missions; those without contact at ticks (`Mission.contact`) have no influence.

    Returns:
        Weight w of dependent robots, in [0, 1]; see `at_least`. Without any ticks, it is 0.4.

    Example:
        >>> 0.0 <= tb.planning.contact_dependence([mission]) <= 1.0
        True
    """
    product = USUAL * _AS_KNOWN
    square = _AS_KNOWN
    for mission in list_of_missions(missions):
        for contact in mission.contact:
            if contact is None or not len(contact) or contact.shape[1] < 2:
                continue

            # Only the shares of at least one and at least two are used.
            n_seeing = contact.sum(1)
            found = np.array([(n_seeing >= k).mean() for k in (1, 2)])
            p = contact.mean(0)
            apart = _apart(p)[:2]
            more = _together(p)[:2] - apart

            product += float((found - apart) @ more)
            square += float(more @ more)
    return float(np.clip(product / square, 0.0, 1.0))


def watchers_along(
    problem: Problem, path: Sequence[Station], draws: Draws, dependence: float, seed: int
) -> pd.DataFrame:
    """Return the expected contact of robots in each bound of a path; see `Planner.watchers`."""
    robots = problem.paths.workspace.team.names
    rates = np.clip(drawn_rates(problem, path, draws, seed), 0.0, 1.0)
    shares = at_least(rates, dependence).mean(0)
    two = shares[:, 1] if len(robots) > 1 else np.zeros(len(shares))

    columns = {f"rate_{name}": rates[..., i].mean(0) for i, name in enumerate(robots)}
    columns |= {"at_least_one": shares[:, 0], "at_least_two": two}
    return pd.DataFrame(columns, index=pd.RangeIndex(1, len(path), name="bound"))


def drawn_rates(problem: Problem, path: Sequence[Station], draws: Draws, seed: int) -> np.ndarray:
    """Draw the contact rates of a path's bounds jointly, shape (draw, bound, robot).

    There is one rate for each draw of the parameters, or several if these are few. Rates of the
    family "gaussian" may be outside [0, 1].
    """
    z, bounds = problem.along(path)
    n_robots = len(z)
    draws.require_valid(n_robots, z.shape[-1])
    draws.require_grid(problem.paths.bounds.shape[1:])
    space = draws.state_space(n_robots, adds_noise=draws.likelihood.adds_noise)
    inputs = draws.along(z, bounds, space)

    index = np.tile(np.arange(draws.n_draws), -(-_FEWEST // draws.n_draws))
    space = space.take(index)
    inputs = [Inputs(*(v[index] if np.ndim(v) else v for v in of_bound)) for of_bound in inputs]

    offset = draws.initial_offset[index, None, None]
    belief = kalman.initial(space, n_robots // space.n_members, offset)
    x0 = problem.initial_trust(None)
    if x0 is not None and draws.carried:
        start = space.grouped(np.broadcast_to(x0, (len(index), n_robots)))
        belief = belief._replace(mean=start)

    rng = stream(seed, "watchers")
    n_ticks = [space.grouped(np.full(n_robots, _TICKS))] * len(inputs)
    ahead = kalman.forecast(space, belief, inputs, n_ticks, draws.likelihood, rng)
    return np.stack([rates for _, rates in ahead], axis=1)


def _together(p: np.ndarray) -> np.ndarray:
    """Return P(at least k) of robots that lose the lead in order: the k-th largest rate."""
    return -np.sort(-p, axis=-1)


def _apart(p: np.ndarray) -> np.ndarray:
    """Return P(at least k) of independent robots (Poisson binomial distribution)."""
    n = p.shape[-1]
    exactly = np.zeros((*p.shape[:-1], n + 1))  # k = 0, 1, ..., n robots have contact
    exactly[..., 0] = 1.0
    for i in range(n):
        p_i = p[..., i, None]
        before = exactly
        exactly = before * (1.0 - p_i)
        exactly[..., 1:] += before[..., :-1] * p_i
    return exactly[..., ::-1].cumsum(-1)[..., -2::-1]
