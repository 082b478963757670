"""The joint normal distribution of all measured rates under one value of the parameters.

With one draw of the parameters, rates are y = C u + x_0 + noise: u the drift of every (mission,
bound, robot), C the propagation beta0^(k - j) of drifts to later rates of the mission. Written as a
dense matrix, every model without a nonlinearity is one case: robots that influence each other, and
effects of places that tie missions together. Its Cholesky factor L, rates in the order of time,
gives the standardised innovations L^-1 (y - mean) of the Kalman filter.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.linalg import solve_triangular

from trustbo.data import Mission, is_line_of_sight
from trustbo.errors import TrustboError
from trustbo.inference.draws import effects_of, is_of_people, memory_of
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.params import CoupledParams, Params, assemble_params
from trustbo.models.place import Visited, correlation, places_of
from trustbo.stacking import MissionBatch, stack_missions

MOST_RATES = 2000
_STARTS = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 1.4])
_SCALES = ("tau_s", "length_scale", "tau_e", "tau_slow", "tau_day")


class Data(NamedTuple):
    """Measured rates in the order of time, and the slots (mission, bound, robot) of all drifts."""

    batch: MissionBatch
    n_bounds: np.ndarray  # (mission,)
    slots: np.ndarray  # (slot, 3): mission, bound from 0, robot
    seen: np.ndarray  # (rate,), slots with a rate
    rates: np.ndarray  # (rate,), as measured
    y: np.ndarray  # (rate,), normal ones that stand for them
    places: Visited | None  # of the model
    sight: tuple[int, ...]  # features that are predicted contact rates
    unit: float  # trust that is one of contact

    @property
    def z(self) -> np.ndarray:
        """Awareness of each slot, (slot, feature)."""
        return self.batch.awareness[*self.slots.T]

    @property
    def line_of_sight(self) -> np.ndarray:
        """Predicted contact rate of each slot (slot,), 1 without such a feature."""
        return self.z[:, list(self.sight)].mean(1) if self.sight else np.ones(len(self.slots))

    @property
    def n_robots(self) -> int:
        """Number of robots."""
        return self.batch.contact_rate.shape[2]


class Normal(NamedTuple):
    """Mean and covariance of the measured rates, and how drifts enter them."""

    mean: np.ndarray  # (rate,)
    cov: np.ndarray  # (rate, rate)
    carry: np.ndarray  # (rate, slot)


class Point(NamedTuple):
    """One value of the parameters, those of places and robots among them."""

    params: Params
    scales: Mapping[str, float]
    rho: float | None  # of robots, see `RobotEffect`


def gather(missions: Sequence[Mission], place: PlaceEffect | None, unit: float = 1.0) -> Data:
    """Data of missions; TrustboError: there are more rates than a dense matrix takes."""
    batch = stack_missions(missions, pad=False)
    n_bounds = np.array([len(mission.bounds) for mission in missions])
    n_robots = batch.contact_rate.shape[2]
    grids = [np.indices((n, n_robots)).reshape(2, -1).T for n in n_bounds]
    mission = np.repeat(np.arange(len(missions)), n_bounds * n_robots)
    slots = np.column_stack([mission, np.concatenate(grids)])
    rates = batch.contact_rate[*slots.T]
    seen = np.flatnonzero(~np.isnan(rates))
    if len(seen) > MOST_RATES:
        raise TrustboError(
            f"{len(seen)} rates are more than the {MOST_RATES} that criticise takes; give the last "
            "missions that hold so many, missions=missions[-n:]."
        )
    places = places_of(missions, place, batch.contact_rate.shape)
    sight = tuple(m for m, name in enumerate(missions[0].features) if is_line_of_sight(name))
    y = rates[seen]
    return Data(batch, n_bounds, slots, seen, y, y, places, sight, unit)


def posterior_point(posterior: xr.DataTree) -> tuple[Point, PlaceEffect | None]:
    """Posterior mean of the parameters, and the effects of places that the model has."""
    draws = posterior["posterior"].to_dataset()
    means = {
        str(n): a.transpose("chain", "draw", ...).values.mean((0, 1)) for n, a in draws.items()
    }
    if is_of_people(posterior):
        raise TrustboError(
            "criticise is of robots' contact; of reports of people, trustbo.compare ranks forms of "
            "HumanTrust, and trustbo.inference.predict_reports scores its predictions."
        )
    if (memory := memory_of(posterior)) != "level":
        raise TrustboError(f'criticise takes memory="level"; this model has "{memory}".')
    x0 = {name: float(posterior.attrs[name]) for name in ("x0_mean", "x0_sd")}
    params = assemble_params({n: np.asarray(m)[None] for n, m in means.items()}, x0).draw(0)
    scales = {name: float(means[name]) for name in _SCALES if name in means}
    record = posterior.attrs.get("place", "none")
    place = None if record == "none" else PlaceEffect(**json.loads(record))
    robots = (e for e in effects_of(posterior) if isinstance(e, RobotEffect))
    return Point(params, scales, next((e.rho for e in robots), None)), place


def joint_normal(point: Point, data: Data) -> Normal:
    """Joint normal of the measured rates at a value of the parameters."""
    params, n = point.params, data.n_robots
    B0, Q, R, drift = _state_space(params, data)
    n_slots = len(data.slots)
    carry, cov, mean = np.zeros((n_slots, n_slots)), np.zeros((n_slots, n_slots)), np.empty(n_slots)
    blocks = {int(K): _mission(int(K), B0, Q, R, params) for K in set(data.n_bounds)}
    end = 0
    for K in data.n_bounds:
        block = slice(end, end + K * n)
        carry[block, block], cov[block, block], start = blocks[int(K)]
        mean[block] = carry[block, block] @ drift[block] + start
        end += K * n
    seen = data.seen
    carry, cov = carry[seen], cov[np.ix_(seen, seen)]
    if data.places is not None:
        cov = cov + _place_cov(carry, data, point.scales)
    if point.rho is not None:
        cov = cov + _robot_cov(carry, data, point)
    return Normal(mean[seen], cov, carry)


def with_start(point: Point, data: Data) -> Point:
    """The point with the most likely mean and sd of trust before the first bound.

    Models fix them, most often far wider than the truth; residuals of first bounds would then be
    too small, and the others relatively too large.
    """
    best, likeliest = -np.inf, point
    for sd in float(point.params.x0_sd) * _STARTS:
        params = point.params._replace(x0_sd=sd)
        normal, moved = (
            joint_normal(point._replace(params=params._replace(x0_mean=m)), data)
            for m in (0.0, 1.0)
        )
        L = np.linalg.cholesky(normal.cov)
        both = np.column_stack([data.y - normal.mean, moved.mean - normal.mean])
        e, a = solve_triangular(L, both, lower=True).T
        mean = (a @ e) / max(a @ a, 1e-300)
        fit = -0.5 * ((e - mean * a) ** 2).sum() - np.log(np.diag(L)).sum()
        if fit > best:
            best, likeliest = fit, point._replace(params=params._replace(x0_mean=mean))
    return likeliest


def varied(point: Point) -> Iterator[tuple[str, tuple[int, ...], float, Point, Point]]:
    """Yield each parameter: its name, index, step, and the points half a step to both sides."""
    for name in point.params._fields[: point.params._fields.index("x0_sd") + 1]:
        value = np.asarray(getattr(point.params, name), dtype=float)
        for where in np.ndindex(value.shape):
            if name.startswith("Delta") and where[0] < where[1]:
                continue  # covariances are symmetric
            step = 1e-4 * max(abs(float(value[where])), 0.01)
            sides = []
            for half in (-0.5, 0.5):
                moved = value.copy()
                for entry in {where, where[::-1]} if name.startswith("Delta") else {where}:
                    moved[entry] += half * step
                params = point.params._replace(**{name: moved})  # pyright: ignore
                sides.append(point._replace(params=params))
            yield name, where, step, sides[0], sides[1]
    for name, value in point.scales.items():
        step = 1e-4 * value
        low, high = ({**point.scales, name: value + half * step} for half in (-0.5, 0.5))
        yield name, (), step, point._replace(scales=low), point._replace(scales=high)


def _state_space(params: Params, data: Data):
    """B0, Q and R (robot, robot), and the drift of each slot."""
    mission, bound, robot = data.slots.T
    if isinstance(params, CoupledParams):
        z = data.batch.awareness
        drift = np.einsum("jkim,mai->jka", z, params.B) + np.asarray(params.b)
        return (
            np.asarray(params.B0), np.asarray(params.Delta_w), np.asarray(params.Delta_v),
            drift[mission, bound, robot],
        )  # fmt: skip
    beta = np.broadcast_to(params.beta, (data.n_robots, data.z.shape[1]))  # pyright: ignore
    beta0, b, w, v = (
        np.broadcast_to(getattr(params, name), data.n_robots)
        for name in ("beta0", "b", "delta_w", "delta_v")
    )
    drift = np.einsum("sm,sm->s", data.z, beta[robot]) + b[robot]
    return np.diag(beta0), np.diag(w**2), np.diag(v**2), drift


def _mission(K: int, B0, Q, R, params: Params):
    """Propagation of drifts, covariance, and the mean from x_0, of one mission of K bounds."""
    n = len(B0)
    eye, down = np.eye(K * n), np.eye(K, k=-1)
    carry = np.linalg.inv(eye - np.kron(down, B0))
    start = carry[:, :n] @ B0
    cov = carry @ np.kron(np.eye(K), Q) @ carry.T + np.kron(np.eye(K), R)
    cov += float(params.x0_sd) ** 2 * start @ start.T
    return carry, cov, float(params.x0_mean) * start.sum(1)


def _place_cov(carry: np.ndarray, data: Data, scales: Mapping[str, float]) -> np.ndarray:
    places = data.places
    assert places is not None  # noqa: S101
    mission, bound, robot = data.slots.T
    unit = places.unit[mission, bound, robot if places.n_effects > 1 else 0]
    effects = carry @ (unit[:, None] == np.arange(len(places.units)))
    K = scales.get("tau_e", 0.0) ** 2 * np.eye(len(places.units))
    if "tau_s" in scales:
        of_cells = correlation(places.cells, places.cells, scales["length_scale"])
        K = K + scales["tau_s"] ** 2 * of_cells[np.ix_(places.cell_of, places.cell_of)]
    return effects @ K @ effects.T


def _robot_cov(carry: np.ndarray, data: Data, point: Point) -> np.ndarray:
    mission, _, robot = data.slots.T
    rest = 1.0 - np.asarray(point.params.beta0)  # pyright: ignore[reportAttributeAccessIssue]
    missions = np.arange(len(data.n_bounds))
    gap = np.abs(missions[:, None] - missions)
    K = point.scales["tau_slow"] ** 2 * float(point.rho or 0.0) ** gap
    K += point.scales["tau_day"] ** 2 * np.eye(len(missions))
    cov = np.zeros((len(carry), len(carry)))
    for i in range(data.n_robots):
        effects = carry @ (
            (rest * data.line_of_sight * (robot == i))[:, None] * (mission[:, None] == missions)
        )
        cov += effects @ K @ effects.T
    return cov
