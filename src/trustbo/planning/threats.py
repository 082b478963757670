"""Where a threat is, from sightings and from the contact that missions lost.

A threat, such as a jammer, lowers trust around its place. At a distance d, its effect is
h exp(-d^2 / (2 l^2)) with the reach l, and h ~ N(0.5, 0.3^2). The place q, the reach and the first
mission with the threat are unknown. For all their values on a grid, the evidence of the contact
rates is that of a Gaussian with one more column x, whose rows are the exposures of the bounds:

    r ~ N(-0.5 x, V + 0.3^2 x x^T).

Here r are the contact rates minus what awareness explains, averaged over the robots, and V is their
covariance by the effects of places, robots and noise in a fitted model, with an independent error
of standard deviation 0.15, because a threat does not have exactly this shape. A threat is thereby
told apart from effects of places, which have the same covariance in all missions and no common
shape. A sighting multiplies the probability of q by its normal density, or is false with
probability 0.05.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import xarray as xr
from scipy.linalg import cho_factor, cho_solve

from trustbo.data import THREAT, Mission, Sighting, require_map, sight_columns
from trustbo.errors import TrustboError, require_kind, require_share
from trustbo.inference.learner import params_of
from trustbo.models.draws import PLACES
from trustbo.models.effects.place import PlaceEffect, matern
from trustbo.models.sight_scale import scale_at, variation
from trustbo.planning.recursion import states_along, trust_recursion
from trustbo.stacking import list_of_missions
from trustbo.workspace import MOVES, Workspace
from trustbo.workspace.moves import bounds_along
from trustbo.workspace.threats import REACHES, exposures

_EFFECT = 0.5
"""Expected loss of trust at the place of a threat."""
_EFFECT_SD = 0.3
_FALSE = 0.05
"""Probability that a sighting is false."""
_MISFIT = 0.15
"""Standard deviation by which the contact of a bound differs from these equations."""


def threat_map(
    missions: Iterable[Mission],
    posterior: xr.DataTree,
    workspace: Workspace,
    *,
    prior: float = 0.1,
) -> xr.Dataset:
    """Infer the place and the reach of a threat from missions and their sightings.

    Args:
        missions: Missions of a campaign in order, with their `sightings`.
        posterior: Posterior of these missions, with place effects.
        workspace: Workspace of the missions.
        prior: Probability of a threat without sightings; with sightings, it is at least 0.95.

    Returns:
        Dataset with `probability` (reach, row, col), the joint posterior probability that a threat
        with this reach (m) is in the cell, whose sum is the probability of a threat, and `began`
        (mission), the probability that it was first there in each mission, given that there is one.

    Raises:
        TrustboError: A mission has no map, the posterior has no place effects or was fitted to
            logits, or `prior` is not between 0 and 1.

    Example:
        >>> threat = tb.planning.threat_map(result.missions, result.posterior, workspace)
        >>> float(threat["probability"].sum())  # probability of a threat
        >>> workspace.with_threat(threat)  # for the next campaign
    """
    missions = list_of_missions(missions)
    require_kind("posterior", posterior, xr.DataTree, "give a posterior from fit")
    require_map("a threat map", missions)
    require_share("prior", prior, ends=False)
    if "places" not in posterior or posterior.attrs.get("family") == "beta_binomial":
        raise TrustboError(
            "a threat map needs a posterior with place effects and Gaussian rates; fit the default "
            "model."
        )

    rest, cov, number, bounds = _residuals(missions, posterior, workspace)
    moves, rows, cols = bounds.T
    exposed = exposures(workspace.grid)[:, :, moves % len(MOVES), rows, cols]
    log_p = _log_evidence(rest, cov, number, exposed, len(missions))  # (mission, reach, cell)

    seen = [sighting for mission in missions for sighting in mission.sightings]
    log_seen, usual = _log_sightings(seen, workspace)
    log_p += log_seen
    log_prior = np.log(max(prior, 0.95)) if seen else np.log(prior)
    log_none = np.log1p(-np.exp(log_prior)) + usual

    joint = log_prior - np.log(log_p.size) + log_p
    of_all = np.logaddexp.reduce(joint, axis=None)
    total = np.logaddexp(of_all, log_none)
    shape = len(REACHES), *workspace.grid.shape
    probability = np.exp(np.logaddexp.reduce(joint, axis=0) - total).reshape(shape)
    began = np.exp(np.logaddexp.reduce(joint, axis=(1, 2)) - of_all)

    cells = workspace.passable.coords
    coords = {"reach": list(REACHES), "mission": np.arange(len(missions)), **cells}
    return xr.Dataset(
        {
            "probability": (("reach", "row", "col"), probability),
            "began": ("mission", began),
        },
        coords,
    )


def _residuals(
    missions: Sequence[Mission], posterior: xr.DataTree, workspace: Workspace
) -> tuple[np.ndarray, ...]:
    """Return contact that awareness does not explain, its covariance, missions and bounds."""
    draws = params_of(posterior, workspace).mean()
    arrays = {name: value for name, value in draws.arrays.items() if name not in PLACES}
    plain = draws._with(arrays=arrays, place_robot=None)

    rest, number, bounds, sight, ticks = [], [], [], [], []
    columns = sight_columns(workspace.features)
    for k, mission in enumerate(missions):
        z = np.swapaxes(mission.awareness, 0, 1).copy()
        z[..., [name == THREAT for name in workspace.features]] = 0.0  # it is to be explained
        along = bounds_along(mission.driven_stations)
        expected = states_along(trust_recursion(plain, z, bounds=along, by_robot=True))[0]
        of_team = z[..., columns].mean((0, -1)) if columns else np.full(len(along), 0.5)

        rate = mission.contact_rate
        known = np.isfinite(rate).any(1)
        rest.append(np.nanmean((rate - expected)[known], axis=1))
        number.append(np.full(known.sum(), k))
        bounds.append(along[known])
        sight.append(of_team[known])
        ticks.append(np.isfinite(rate).sum(1)[known])

    at, of_mission = np.concatenate(bounds), np.concatenate(number)
    changes = variation(np.concatenate(sight))
    noise = _mean(posterior, "delta_v")
    if "f_v" in posterior["posterior"]:
        noise = noise * scale_at(changes, _mean(posterior, "f_v"))

    # Effects of places.
    same = (at[:, None] == at).all(-1)
    apart = np.linalg.norm(at[:, None, 1:] - at[:, 1:].astype(float), axis=-1)
    cov = _mean(posterior, "tau_s") ** 2 * matern(apart, _mean(posterior, "length_scale"))
    if PlaceEffect.group in posterior:
        g = scale_at(changes, posterior[PlaceEffect.group].attrs["f_e"])
        cov += _mean(posterior, "tau_e") ** 2 * np.outer(g, g) * same

    # Effects of robots, and noise.
    by_mission = of_mission[:, None] == of_mission
    of_robots = sum(_mean(posterior, name) ** 2 for name in ("tau_slow", "tau_mission"))
    cov += of_robots / workspace.team.n_robots * by_mission
    cov += np.diag(noise**2 / np.concatenate(ticks) + _MISFIT**2)
    return np.concatenate(rest), cov, of_mission, at


def _mean(posterior: xr.DataTree, name: str) -> float:
    """Return the posterior mean of a hyperparameter; 0 if the model has none of that name."""
    group = posterior["posterior"].to_dataset()
    return float(group[name].mean()) if name in group else 0.0


def _log_evidence(
    rest: np.ndarray,
    cov: np.ndarray,
    number: np.ndarray,
    exposed: np.ndarray,
    n_missions: int,
) -> np.ndarray:
    """Compute the log evidence ratio (mission, reach, cell) of a threat that began in a mission.

    `exposed` (reach, cell, bound) are the exposures of the bounds of the missions `number` (bound,)
    while there is a threat.
    """
    n = len(rest)
    factor = cho_factor(cov)
    solved = cho_solve(factor, rest)
    precision_before = _EFFECT_SD**-2.0

    ratios = []
    for first in range(n_missions):
        x = np.where(number >= first, exposed, 0.0).reshape(-1, n).T

        # The marginal likelihood ratio of the effect h ~ N(mu, s^2) on -x, in closed form.
        precision = (x * cho_solve(factor, x)).sum(0) + precision_before
        shift = _EFFECT * precision_before - x.T @ solved
        log_ratio = shift**2 / precision - _EFFECT**2 * precision_before
        log_ratio = 0.5 * (log_ratio - np.log(precision / precision_before))
        ratios.append(log_ratio.reshape(exposed.shape[:2]))
    return np.array(ratios)


def _log_sightings(seen: Sequence[Sighting], workspace: Workspace) -> tuple[np.ndarray, float]:
    """Return the log density (cell,) of the sightings by cell, and without a threat."""
    grid = workspace.grid
    x, y = (axis.ravel() for axis in np.meshgrid(grid.x, grid.y))
    area = grid.cell_height * grid.cell_width * x.size

    found = np.zeros(x.size)
    for sighting in seen:
        var = sighting.sd**2 + grid.cell_height * grid.cell_width / 12.0
        d2 = (x - sighting.x) ** 2 + (y - sighting.y) ** 2
        true = np.exp(-0.5 * d2 / var) / (2.0 * np.pi * var)
        found += np.log((1.0 - _FALSE) * true + _FALSE / area)
    return found, len(seen) * (np.log(_FALSE) - np.log(area))
