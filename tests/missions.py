"""Missions made for tests, and the parameters that they are drawn from."""

import numpy as np
from hypothesis import strategies as st

from trustbo.data import Mission
from trustbo.models import TrustParams
from trustbo.models.families import FAMILIES

TRUTH = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
N_TICKS = 20
OF_FAMILY = {
    "gaussian": TrustParams(0.6, np.array([0.5, 0.3]), -0.1, 0.1, 0.1),
    "censored": TrustParams(0.6, np.array([0.5, 0.3]), -0.1, 0.15, 0.1),
    "beta_binomial": TrustParams(0.6, np.array([2.0, 1.0]), -0.6, 0.4, 0.25, 0.0, 1.5),
}
OF_FAMILY = {name: params.replace(family=name) for name, params in OF_FAMILY.items()}


def draw_rates(params, awareness, *, family="gaussian", n_ticks=np.nan, seed=0):
    """Rates (mission, bound, robot) of the pooled model for given parameters."""
    rng, n_robots = np.random.default_rng([0, seed, 0x6D697373]), awareness.shape[2]
    as_map = np.moveaxis(awareness, 2, 0)[:, None]  # (robot, 1, mission, bound, feature)
    u = np.moveaxis(params.inputs(as_map)[0, :, 0], 0, -1)
    if params.memory == "deviation":  # x - u lasts
        first = np.full_like(u[:, :1], params.x0_mean)
        u = u - params.beta0 * np.concatenate([first, u[:, :-1]], axis=1)
    w, _ = rng.standard_normal((2, awareness.shape[1], len(awareness), n_robots))
    x = params.x0_mean + params.x0_sd * rng.standard_normal((len(awareness), n_robots))
    rates = np.empty(awareness.shape[:3])
    for k in range(rates.shape[1]):
        x = params.beta0 * x + u[:, k] + params.delta_w * w[k]
        rates[:, k] = FAMILIES[family].sample(x, params.delta_v, n_ticks, rng)
    return rates


def simulate_missions(n_missions=6, seed=0, truth=TRUTH, lengths=(7, 5, 8)):
    """Missions of three robots whose rates the pooled model draws."""
    rng = np.random.default_rng(seed)
    awareness = rng.uniform(size=(n_missions, 8, 3, 2))
    sample = draw_rates(truth, awareness, seed=seed)
    missions = []
    for j in range(n_missions):
        n = lengths[j % len(lengths)]
        rates = np.clip(sample[j, :n], 0.0, 1.0)
        path = [(0, k) for k in range(n + 1)]
        missions.append(Mission.from_arrays(path, awareness[j, :n], rates))
    return missions


def counted_missions(family, seed=0, n=6, low=0.0):
    """Awareness, rates in shares of `N_TICKS`, one missing, and their missions of one robot."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(size=(n, 5, 1, 2))
    y = draw_rates(OF_FAMILY[family], z, family=family, n_ticks=N_TICKS, seed=seed)
    y = np.round(np.clip(y, low, 1.0 - low) * N_TICKS) / N_TICKS
    y[0, 2] = np.nan
    path = [(0, k) for k in range(6)]
    n_ticks = np.full((5, 1), N_TICKS)
    missions = [Mission.from_arrays(path, a, b, n_ticks=n_ticks) for a, b in zip(z, y, strict=True)]
    return z, y, missions


def walking_missions(seed, n_missions=4, shape=(5, 5), n_bounds=(4, 10), missing=0.2):
    """Missions of three robots on random walks over a grid, whose rates no model has drawn."""
    rng, missions = np.random.default_rng(seed), []
    for _ in range(n_missions):
        n, path = int(rng.integers(*n_bounds)), [tuple(rng.integers(shape).tolist())]
        while len(path) <= n:
            row, col = np.array(path[-1]) + rng.integers(-1, 2, size=2)
            if 0 <= row < shape[0] and 0 <= col < shape[1] and (row, col) != path[-1]:
                path.append((int(row), int(col)))
        rates = rng.uniform(size=(n, 3))
        rates[rng.uniform(size=rates.shape) < missing] = np.nan
        missions.append(Mission.from_arrays(path, rng.uniform(size=(n, 3, 2)), rates))
    return missions


def random_params(rng):
    """Parameters of the pooled model, far wider than its prior."""
    return TrustParams(
        beta0=rng.uniform(-0.9, 1.1),
        beta=rng.normal(0.0, 1.0, 2),
        b=rng.normal(0.0, 0.5),
        delta_w=rng.uniform(0.01, 0.5),
        delta_v=rng.uniform(0.01, 0.5),
        x0_mean=rng.normal(0.5, 0.3),
        x0_sd=rng.uniform(0.0, 0.7),
    )


@st.composite
def missions(draw, *, ticks=True):
    """Missions of one team, as files must keep them: with or without a map, with what is missing.

    With `ticks`, some bounds have poses and contacts of ticks.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    mapped, n_features = draw(st.booleans()), draw(st.integers(1, 3))
    robots = draw(st.permutations(["husky", "r 2", "ü-7", "12"]))[: draw(st.integers(1, 3))]
    features = tuple(draw(st.permutations(["near", "line_of_sight", "z3"])))[:n_features]
    made = []
    for _ in range(draw(st.integers(1, 3))):
        n_planned, n_run = sorted(draw(st.tuples(st.integers(1, 4), st.integers(1, 4))))[::-1]
        n_run = n_run if mapped else n_planned
        status = draw(st.sampled_from(["stuck", "aborted"])) if n_run < n_planned else "ok"
        path = tuple(tuple(cell) for cell in rng.integers(0, 9, (n_planned + 1, 2)).tolist())
        rows, recorded, starts = [], [], [float(draw(st.sampled_from([0.0, 0.1, 7.0 / 3.0])))]
        for _ in range(n_run):
            z = rng.uniform(size=(len(robots), n_features)) * (1.0 if mapped else 9.0)
            n_ticks = rng.integers(1, 30, len(robots)).astype(float)
            rate = np.round(rng.uniform(size=len(robots)) * n_ticks) / n_ticks
            duration = rng.uniform(0.1, 99.0, len(robots))
            for values in (z, rate, duration, n_ticks):
                values[rng.uniform(size=values.shape) < draw(st.sampled_from([0.0, 0.4]))] = np.nan
            poses = contact = None
            if ticks and draw(st.booleans()):
                n = draw(st.integers(1, 4))
                poses = rng.normal(size=(n, 1 + len(robots), 3))
                contact = rng.uniform(size=(n, len(robots))) < 0.5
            rows.append((z, rate, duration, n_ticks))
            recorded.append((poses, contact))
            ends = starts[-1] + float(np.nanmax(duration, initial=0.0))
            starts.append(ends + float(rng.choice([0.0, 0.3])))
        poses, contact = zip(*recorded, strict=True)
        made.append(
            Mission(
                path if mapped else (),
                *map(np.stack, zip(*rows, strict=True)),
                starts=tuple(starts[:-1]),
                bound_status=(*["ok"] * (n_run - 1), status),
                status=status,
                features=features,
                robots=tuple(robots),
                poses=poses,
                contact=contact,
            )
        )
    return made


def assert_same_missions(found, expected, *, ticks=True):
    """Every number and name of missions is as it was."""
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        for name in ("path", "status", "features", "robots", "scale"):
            assert getattr(one, name) == getattr(other, name), name
        assert len(one.bounds) == len(other.bounds)
        for a, b in zip(one.bounds, other.bounds, strict=True):
            assert (a.cell, a.status, a.t0) == (b.cell, b.status, b.t0)
            kept = ("poses", "contact") if ticks else ()
            for name in ("awareness", "contact_rate", "duration", "n_ticks", *kept):
                x, y = getattr(a, name), getattr(b, name)
                assert (x is None) == (y is None), name
                assert x is None or np.array_equal(x, y, equal_nan=x.dtype.kind == "f"), name
