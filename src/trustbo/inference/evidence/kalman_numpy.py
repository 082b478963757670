"""The recursions of `scalar` in NumPy, under many draws at once: latent trust at the end of a fit.

Compiling them would take longer than running them. Sequences of one length share their variances,
which depend on the draw alone; draws are the last, contiguous axis.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from trustbo.inference.evidence.gram import lengths
from trustbo.models.params import Params
from trustbo.models.state_space.kalman import innovation, look_back, update
from trustbo.stacking import MissionBatch

_CELLS = 1 << 18  # numbers per array and chunk of draws: what the cache holds
_LEAST_VARIANCE = 1e-300


class TrustSummary(NamedTuple):
    """Latent trust over all draws, and the likelihood of each."""

    mean: np.ndarray  # (mission, bound, robot)
    sd: np.ndarray  # (mission, bound, robot)
    log_likelihood: np.ndarray  # (draw, mission)


def summarize(
    params: Params, batch: MissionBatch, n_bounds: np.ndarray | None = None
) -> TrustSummary:
    """Mean and sd of latent trust over all draws, and each mission's log-likelihood per draw.

    Args:
        params: Draws with leading axis (draw,).
        batch: Missions, padded with NaN.
        n_bounds: Bounds of each mission, measured or not; by default all of the batch.
    """
    n = len(params.b)
    shape = batch.contact_rate.shape
    total, squares = np.zeros(shape), np.zeros(shape)
    log_likelihood = np.zeros((n, shape[0]))
    for group in _groups(params, batch, n_bounds):
        step = max(1, _CELLS // group.y.size)
        for start in range(0, n, step):
            draws = slice(start, start + step)
            p = _Draws(*(column[..., draws] for column in group.draws))
            f = _filter(p, group)
            np.add.at(log_likelihood[draws].T, group.mission, f.log_likelihood)
            m, P = f.mean[-1], f.var[-1]
            for k in range(len(group.y) - 1, -1, -1):
                if k < len(group.y) - 1:
                    A, a, V = _backward(p, f, k)
                    m, P = A * m + a, V + A**2 * P
                total[group.mission, k, group.robot] += m.sum(-1)
                spread = np.broadcast_to(P, m.shape)
                squares[group.mission, k, group.robot] += (spread + m**2).sum(-1)
    mean = total / n
    return TrustSummary(mean, np.sqrt(np.maximum(squares / n - mean**2, 0.0)), log_likelihood)


def one_step(
    params: Params, batch: MissionBatch, n_bounds: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd of each rate given the draw and the rates of bounds before.

    Args as for `summarize`. Returns arrays (draw, mission, bound, robot).
    """
    mean = np.full((len(params.b), *batch.contact_rate.shape), np.nan)
    sd = mean.copy()
    for group in _groups(params, batch, n_bounds):
        f = _filter(group.draws, group)
        for k, (expected, variance) in enumerate(zip(f.rate_mean, f.rate_var, strict=True)):
            mean[:, group.mission, k, group.robot] = expected.T
            spread = np.broadcast_to(np.sqrt(variance), expected.shape)
            sd[:, group.mission, k, group.robot] = spread.T
    return mean, sd


def sample(
    params: Params,
    batch: MissionBatch,
    rng: np.random.Generator,
    n_bounds: np.ndarray | None = None,
) -> np.ndarray:
    """One exact joint draw of latent trust per parameter draw, (draw, mission, bound, robot)."""
    trust = np.zeros((len(params.b), *batch.contact_rate.shape))
    for group in _groups(params, batch, n_bounds):
        p, e = group.draws, rng.standard_normal((*group.y.shape, len(params.b)))
        f = _filter(p, group)
        x = f.mean[-1] + np.sqrt(f.var[-1]) * e[-1]
        for k in range(len(group.y) - 1, -1, -1):
            if k < len(group.y) - 1:
                A, a, V = _backward(p, f, k)
                x = A * x + a + np.sqrt(V) * e[k]
            trust[:, group.mission, k, group.robot] = x.T
    return trust


class _Draws(NamedTuple):
    """Parameters of one robot or of all, draws last."""

    beta0: np.ndarray
    beta: np.ndarray  # (feature, draw)
    b: np.ndarray  # (draw,), or (bound, sequence, draw)
    delta_w: np.ndarray
    delta_v: np.ndarray
    x0_mean: np.ndarray
    x0_sd: np.ndarray

    def drift(self, z: np.ndarray, k: int) -> np.ndarray:
        """Increment of trust by bound k at awareness z (sequence, feature), (sequence, draw)."""
        return z @ self.beta + (self.b if self.b.ndim == 1 else self.b[k])


class _Group(NamedTuple):
    """Sequences filtered in one batch, with common or separate patterns of missing rates."""

    draws: _Draws
    mission: np.ndarray  # (sequence,)
    robot: np.ndarray  # (sequence,)
    y: np.ndarray  # (bound, sequence), 0 where missing
    z: np.ndarray  # (bound, sequence, feature)
    seen: np.ndarray  # (bound, sequence, 1), or (bound, 1, 1) where all share it


class _Filtered(NamedTuple):
    mean: list[np.ndarray]  # per bound, (sequence, draw)
    var: list[np.ndarray]  # per bound, (sequence or 1, draw)
    drift: list[np.ndarray]  # per bound, (sequence, draw)
    rate_mean: list[np.ndarray]  # of each rate given those before, (sequence, draw)
    rate_var: list[np.ndarray]  # (sequence or 1, draw)
    log_likelihood: np.ndarray  # (sequence, draw)


def _groups(
    params: Params, batch: MissionBatch, n_bounds: np.ndarray | None = None
) -> Iterator[_Group]:
    n_missions, longest, n_robots = batch.contact_rate.shape
    n_bounds = np.full(n_missions, longest) if n_bounds is None else n_bounds
    params = params.with_drift(batch.awareness)
    b, n_draws = np.asarray(params.b), len(params.b)
    of_bounds = b.ndim == 4  # (draw, mission, bound, robot), see `Params.on`
    for members in params.alike(n_robots):
        shared = params._replace(b=np.zeros((n_draws, n_robots))) if of_bounds else params
        draws = _draws_last(shared.of_robot(members[0]))
        mission, robot = (a.ravel() for a in np.meshgrid(range(n_missions), members, indexing="ij"))
        y = batch.contact_rate[mission, :, robot].T
        seen = ~np.isnan(y)
        length, complete = lengths(seen.T)
        # Bounds after the last rate are predicted: trust has a mean and a variance there too.
        kinds = np.stack([n_bounds[mission], np.where(complete, length, longest + 1)])
        for n, measured in np.unique(kinds, axis=1).T:
            rows = np.flatnonzero((kinds == [[n], [measured]]).all(0))
            here = seen[:n, rows, None]
            if of_bounds:
                effect = np.minimum(robot[rows], b.shape[3] - 1)
                draws = draws._replace(b=b[:, mission[rows], :n, effect].transpose(2, 0, 1).copy())
            yield _Group(
                draws,
                mission[rows],
                robot[rows],
                np.where(seen, y, 0.0)[:n, rows],
                np.swapaxes(batch.awareness[mission[rows], :n, robot[rows]], 0, 1),
                here[:, :1] if measured <= longest else here,
            )


def _draws_last(params: Params) -> _Draws:
    n = len(params.b)

    def column(value: np.ndarray) -> np.ndarray:
        value = np.broadcast_to(np.asarray(value, dtype=float), (n, *np.shape(value)[1:]))
        return np.ascontiguousarray(value.T)

    return _Draws(*(column(getattr(params, name)) for name in _Draws._fields))


def _filter(p: _Draws, group: _Group) -> _Filtered:
    Q, R = p.delta_w**2, p.delta_v**2
    m = np.broadcast_to(p.x0_mean, (len(group.mission), len(p.beta0)))
    P = np.broadcast_to(p.x0_sd**2, (group.seen.shape[1], len(p.beta0)))
    means, variances, drifts, expected, spreads = [], [], [], [], []
    log_likelihood = np.zeros(m.shape)
    for k, (y, z, seen) in enumerate(zip(group.y, group.z, group.seen, strict=True)):
        drift = p.drift(z, k)
        S, C = innovation(p.beta0, Q, R, P)
        gain = np.where(seen, C / S, 0.0)
        expected.append(p.beta0 * m + drift)
        spreads.append(S)
        e = y[:, None] - expected[-1]
        m = p.beta0 * m + drift + gain * e
        P = update(p.beta0, Q, P, gain, S)
        log_likelihood -= np.where(seen, 0.5 / S, 0.0) * e**2
        log_likelihood -= np.where(seen, 0.5 * np.log(2.0 * np.pi * S), 0.0)
        means.append(m)
        variances.append(P)
        drifts.append(drift)
    return _Filtered(means, variances, drifts, expected, spreads, log_likelihood)


def _backward(p: _Draws, f: _Filtered, k: int):
    """A, a, V with x_k | x_{k+1}, y ~ N(A x_{k+1} + a, V), see `kalman.look_back`."""
    # A far draw's process noise may be so small that its square is 0, where Q would divide.
    Q, P = np.maximum(p.delta_w**2, _LEAST_VARIANCE), np.maximum(f.var[k], _LEAST_VARIANCE)
    A, V = look_back(p.beta0, Q, P)
    a = V / P * f.mean[k] - V * p.beta0 / Q * f.drift[k + 1]
    return A, a, V
