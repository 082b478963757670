"""Trust in each robot at each cell against the formula of its steady state, bound by bound."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from missions import walking_missions
from scipy.special import expit
from scipy.stats import norm

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.inference import params_of, sample_prior
from trustbo.inference.learner import learner_of
from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    PlaceEffect,
    PooledTrust,
    RobotEffect,
    TrustParams,
)
from trustbo.planning import Planner, expected_trust, robot_trust
from trustbo.workspace.moves import MOVE_NAMES, MOVES

ENDS = (3, 0), (0, 3)
ROBOTS = ("ant", "bee", "cow")


@pytest.fixture(scope="module")
def workspace():
    passable = np.ones((4, 4), bool)
    passable[[0, 1, 1], [1, 0, 1]] = False  # nothing enters the corner (0, 0)
    z = np.random.default_rng(3).uniform(size=(3, 8, 4, 4, 2))
    team = tb.Team(3, names=ROBOTS)
    return tb.Workspace.from_awareness(z, passable, team=team, cell_size=20.0)


def bounds_into(workspace, cell):
    """Numbers of the moves that enter a cell from a passable cell, found one by one."""
    rows, cols = workspace.passable.shape
    moves = []
    for m, (down, right) in enumerate(MOVES):
        row, col = cell[0] - down, cell[1] - right
        if 0 <= row < rows and 0 <= col < cols and workspace.passable.values[row, col]:
            moves.append(m)
    return moves


def saturating(awareness, contact_rate=None):
    """A NumPyro function whose robots have different weights."""
    most = numpyro.sample("most", dist.HalfNormal(0.5).expand([3]).to_event(1))
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    drift = most * (1.0 - jnp.exp(-2.0 * awareness[..., 1]))
    with numpyro.plate("mission", len(drift)):
        rates = tb.models.ContactRate(drift, beta0, 0.1, 0.1)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def stationary(model, draws, z, d):
    """Trust (robot,) if a bound with awareness (robot, feature) is repeated, by the equations."""
    if model is saturating:
        drift = draws.values["most"][d] * (1.0 - np.exp(-2.0 * z[:, 1]))
        return drift / (1.0 - draws.values["beta0"][d])
    if isinstance(model, CoupledTrust):
        B0, B, b = draws.B0[d], draws.B[d], draws.b[d]
        drift = b + sum(B[m] @ z[:, m] for m in range(2))
        return np.linalg.solve(np.eye(3) - B0, drift)
    if isinstance(model, HierarchicalTrust):
        drift = (draws.beta[d] * z).sum(1) + draws.b[d]
        return drift / (1.0 - draws.beta0[d])
    drift = z @ draws.beta[d] + draws.b[d]
    return drift if draws.memory == "deviation" else drift / (1.0 - draws.beta0[d])


MODELS = {
    "pooled": PooledTrust(),
    "deviation": PooledTrust(memory="deviation"),
    "shared noise": PooledTrust(shared_noise=True),
    "hierarchical": HierarchicalTrust(),
    "coupled": CoupledTrust(),
    "function": saturating,
}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.filterwarnings("ignore:.*no stationary trust")
def test_trust_is_the_steady_state_averaged_over_the_bounds_that_enter_a_cell(
    workspace, name, monkeypatch
):
    model = MODELS[name]
    draws = learner_of(model, workspace).prior_draws(7, 1, workspace)
    monkeypatch.setattr(robot_trust, "_NUMBERS", 3 * 40 * 2)  # two or three draws at a time
    planner = Planner(workspace, *ENDS)
    trust = planner.trust(draws)
    assert (trust.dims, trust.shape) == (("draw", "robot", "row", "col"), (7, 3, 4, 4))
    diverges = np.zeros(7, bool)
    if name == "coupled":
        diverges = np.abs(np.linalg.eigvals(draws.B0)).max(-1) >= 1.0
    np.testing.assert_array_equal(np.isnan(trust).all(("robot", "row", "col")), diverges)

    rtol = 1e-6 if model is saturating else 1e-9  # a function draws numbers of single precision
    z = workspace.awareness.values
    for cell in [(3, 0), (2, 2), (0, 3)]:
        moves = bounds_into(workspace, cell)
        for d in np.flatnonzero(~diverges):
            by_move = [stationary(model, draws, z[:, m, *cell], d) for m in moves]
            np.testing.assert_allclose(trust[d, :, *cell], np.mean(by_move, axis=0), rtol=rtol)
            one = planner.trust(draws, "bee", cell, move=MOVE_NAMES[moves[0]])
            assert one.dims == ("draw",)
            assert one[d] == pytest.approx(by_move[0][1], rel=rtol)

    for robot, cell in (("cow", None), (None, (2, 2)), ("cow", (2, 2))):
        part = {} if robot is None else {"robot": robot}
        part |= {} if cell is None else dict(zip(("row", "col"), cell, strict=True))
        expected = trust.sel(part)
        found = planner.trust(draws, robot, cell)
        assert found.dims == expected.dims
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert np.isnan(trust[:, :, 1, 1]).all()
    assert np.isnan(trust[:, :, 0, 0]).all()


def test_trust_is_what_expected_trust_tends_to_if_a_bound_is_repeated(workspace):
    draws = sample_prior(CoupledTrust(), 2, 1, 3, n_robots=3).draw(0)
    draws = draws.replace(B0=0.8 * draws.B0 / np.abs(np.linalg.eigvals(draws.B0)).max())
    z = np.repeat(workspace.along([(3, 0), (3, 1)]), 200, axis=0)
    found = Planner(workspace, *ENDS).trust(draws, cell=(3, 1), move="e")
    np.testing.assert_allclose(found, expected_trust(draws, z)[0, -1], rtol=1e-9)


def test_effects_of_places_are_part_of_the_trust_at_the_place(workspace):
    rng = np.random.default_rng(0)
    place = rng.normal(size=(2, 3, 4, 4))
    bounds = rng.normal(size=(2, 1, 8, 4, 4))
    beta0 = np.array([0.5, 0.2])
    draws = TrustParams(
        beta0, rng.normal(size=(2, 2)), np.zeros(2), np.full(2, 0.1), np.full(2, 0.1),
        place=place, place_bound=bounds,
    )  # fmt: skip
    moves = bounds_into(workspace, (2, 3))
    drift = np.einsum("df,imf->dim", draws.beta, workspace.awareness.values[:, moves, 2, 3])
    drift += place[:, :, 2, 3, None] + bounds[:, :, moves, 2, 3]
    expected = drift.mean(-1) / (1.0 - beta0[:, None])
    planner = Planner(workspace, *ENDS)
    np.testing.assert_allclose(planner.trust(draws, cell=(2, 3)), expected)
    small = tb.Workspace.from_awareness(np.full((3, 3, 3, 2), 0.5))
    with pytest.raises(TrustboError, match="cells"):
        Planner(small, (0, 0), (2, 2)).trust(draws)


def test_trust_in_a_robot_has_its_own_effect_in_the_bound_and_that_of_the_team_has_not():
    missions = walking_missions(0, 3)
    posterior = tb.fit(
        missions, PooledTrust(effects=PlaceEffect()), progress=False, check=False, latent=False
    )
    places = posterior["places"].to_dataset().isel(bound=0)
    move = MOVE_NAMES[int(places["bound_move"])]
    cell = int(places["bound_row"]), int(places["bound_col"])

    z = np.full((3, *(int(n) for n in posterior["places"].attrs["shape"]), 2), 0.5)
    alike = tb.Workspace.from_awareness(z)
    planner = Planner(alike, (0, 0), (2, 2))
    trust = planner.trust(posterior, cell=cell, move=move).values
    own = places["place_robot"].transpose("chain", "draw", "robot").values.reshape(-1, 3)
    beta0 = posterior["posterior"]["beta0"].values.reshape(-1, 1)
    team = trust.mean(1, keepdims=True)
    np.testing.assert_allclose(trust - team, own / (1.0 - beta0), atol=1e-7)

    mean = planner.trust(params_of(posterior, alike), cell=cell, move=move).values
    np.testing.assert_allclose(mean, np.broadcast_to(team, mean.shape), atol=1e-9)


@pytest.fixture(scope="module")
def with_robot_effects():
    """A posterior with effects of robots in proportion to line of sight, and its workspace."""
    rng = np.random.default_rng(5)
    features = ("line_of_sight", "visibility")
    missions = []
    for mission in walking_missions(1, 5, shape=(4, 4), missing=0.0):
        z = rng.uniform(size=mission.awareness.shape)
        rates = z[..., 0] - [0.0, 0.2, 0.0] + rng.normal(0.0, 0.15, 3)
        rates = np.clip(rates + rng.normal(0.0, 0.05, z.shape[:2]), 0.0, 1.0)
        missions.append(tb.Mission.from_arrays(mission.path, z, rates, features=features))

    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()])
    posterior = tb.fit(missions, model, draws=4000, progress=False, check=False, latent=False)
    z = rng.uniform(size=(3, 8, 4, 4, 2))
    return posterior, tb.Workspace.from_awareness(z, features=features)


def test_trust_of_the_next_mission_has_the_variance_of_the_next_effects(with_robot_effects):
    posterior, workspace = with_robot_effects
    planner = Planner(workspace, *ENDS)
    bound = {"cell": (2, 2), "move": "s"}
    drawn = planner.trust(posterior, **bound).values
    expected = planner.trust(posterior, **bound, expected=True).values
    sight = workspace.awareness.values[:, MOVE_NAMES.index("s"), 2, 2, 0]

    # The variance of the next effect, given those of the n missions before, for each draw.
    theta = posterior["posterior"].to_dataset().squeeze("chain")
    lasting = theta["tau_lasting"].values[:, None, None] ** 2
    slow = theta["tau_slow"].values[:, None, None] ** 2
    day = theta["tau_mission"].values[:, None, None] ** 2
    n = posterior.attrs["n_missions"]
    lag = np.abs(np.subtract.outer(np.arange(n + 1), np.arange(n + 1)))
    cov = lasting + slow * 0.9**lag + day * np.eye(n + 1)
    known, ahead = cov[:, :n, :n], cov[:, :n, n]
    explained = np.linalg.solve(known, ahead[..., None])[..., 0]
    variance = cov[:, n, n] - (explained * ahead).sum(1)

    # The difference of a draw is normal with this variance times squared sight.
    n_draws = len(drawn)
    unit = (drawn - expected) / (sight * np.sqrt(variance)[:, None])
    assert np.abs(unit.mean(0)).max() < 4.0 / np.sqrt(n_draws)
    np.testing.assert_allclose(unit.var(0), 1.0, atol=4.0 * np.sqrt(2.0 / n_draws))
    assert np.abs(np.corrcoef(unit.T) - np.eye(3)).max() < 4.0 / np.sqrt(n_draws)

    # So the mean of trust stays, and its variance is larger by the mean of these variances.
    added = variance.mean() * sight**2
    assert (np.abs(drawn.mean(0) - expected.mean(0)) < 4.0 * np.sqrt(added / n_draws)).all()
    grown = drawn.var(0) - expected.var(0)
    np.testing.assert_allclose(grown, added, rtol=0.15)


def test_maps_of_the_next_mission_are_those_of_drawn_effects(with_robot_effects):
    posterior, workspace = with_robot_effects
    planner = Planner(workspace, *ENDS)
    drawn = params_of(posterior, workspace, next_mission=True)
    plans = params_of(posterior, workspace)
    for name in ("robot_maps", "maps", "trust_map", "cost_map"):
        maps = getattr(planner, name)
        found = maps(posterior)
        of_drawn = maps(drawn)
        of_expected = maps(posterior, expected=True)
        if name == "maps":  # paths are planned for expected effects
            paths = maps(plans)["path_probability"]
            xr.testing.assert_equal(of_expected["path_probability"], paths)
            of_drawn = of_drawn.assign(path_probability=paths)
        xr.testing.assert_equal(found, of_drawn)
        assert not of_expected.equals(found)

    # The mean over robots has no effects of robots in bounds, so that maps are those of plans.
    xr.testing.assert_allclose(planner.maps(posterior, expected=True), planner.maps(plans))


@pytest.mark.parametrize("family", ["gaussian", "censored", "beta_binomial"])
def test_rates_are_the_mean_of_the_family_at_the_trust_of_each_bound(workspace, family):
    draws = sample_prior(HierarchicalTrust(), 2, 20, 4, n_robots=3).replace(family=family)
    planner = Planner(workspace, *ENDS)
    trust = planner.trust(draws, "ant", (2, 2), move="s").values
    sd = draws.delta_v[:, 0]
    rate = {
        "gaussian": np.clip(trust, 0.0, 1.0),
        # The mean of N(x, sd^2) clipped to [0, 1] is the integral of P(y > t) over t in [0, 1].
        "censored": norm.sf((np.linspace(0, 1, 20001)[:, None] - trust) / sd).mean(0),
        "beta_binomial": expit(trust),
    }[family]
    found = planner.trust(draws, "ant", (2, 2), move="s", as_rate=True)
    np.testing.assert_allclose(found, rate, atol=1e-4)
    moves = [MOVE_NAMES[m] for m in bounds_into(workspace, (2, 2))]
    by_move = [planner.trust(draws, "ant", (2, 2), move=m, as_rate=True) for m in moves]
    mean = planner.trust(draws, "ant", (2, 2), as_rate=True)
    np.testing.assert_allclose(mean, np.mean(by_move, axis=0), rtol=1e-12)


def test_maps_of_robots_are_the_mean_and_the_sd_over_draws(workspace, monkeypatch):
    draws = sample_prior(HierarchicalTrust(), 2, 30, 4, n_robots=3)
    planner = Planner(workspace, *ENDS)
    trust = planner.trust(draws)
    rate = planner.trust(draws, as_rate=True)
    monkeypatch.setattr(robot_trust, "_NUMBERS", 3 * 40 * 7)
    maps = planner.robot_maps(draws)
    assert maps["trust_mean"].dims == ("robot", "y", "x")
    np.testing.assert_allclose(maps["trust_mean"], trust.mean("draw"), rtol=1e-12)
    np.testing.assert_allclose(maps["trust_sd"], trust.std("draw", skipna=False), rtol=1e-9)
    np.testing.assert_allclose(maps["contact_rate"], rate.mean("draw"), rtol=1e-12)
    one = planner.trust(draws.mean())
    assert one.dims == ("robot", "row", "col")


def test_draws_in_which_trust_diverges_are_left_out_with_a_warning(workspace):
    draws = TrustParams(
        np.array([0.5, 1.0, 0.0]), np.ones((3, 2)), np.zeros(3), np.full(3, 0.1), np.full(3, 0.1)
    )
    planner = Planner(workspace, *ENDS)
    with pytest.warns(UserWarning, match="1 of 3 draws"):
        trust = planner.trust(draws, "ant", (2, 2))
    assert np.isnan(trust).values.tolist() == [False, True, False]
    assert trust[0] == pytest.approx(2.0 * trust[2])
    with pytest.warns(UserWarning, match="1 of 3 draws"):
        maps = planner.robot_maps(draws)
    np.testing.assert_allclose(maps["trust_mean"].sel(robot="ant")[2, 2], trust.mean())
    with pytest.raises(TrustboError, match="beta0"):
        planner.trust(draws.draw(1))


@pytest.mark.parametrize(
    ("what", "wrong"),
    [
        ("robot", {"robot": "dog"}), ("robot", {"robot": 0}),
        ("cell", {"cell": (1, 1)}), ("cell", {"cell": (4, 0)}), ("cell", {"cell": "a"}),
        ("cell", {"cell": {"x": -5.0, "y": 0.0}}), ("no bound", {"cell": (0, 0)}),
        ("no bound", {"cell": (3, 0), "move": "e"}), ("move", {"move": "up"}),
    ],
)  # fmt: skip
def test_unknown_robots_moves_and_places_are_refused(workspace, what, wrong):
    draws = sample_prior(PooledTrust(), 2, 2, 0)
    with pytest.raises(TrustboError, match=what):
        Planner(workspace, *ENDS).trust(draws, **wrong)


def test_a_move_that_enters_no_cell_is_refused():
    row = tb.Workspace.from_awareness(np.full((1, 1, 4, 2), 0.5))
    draws = sample_prior(PooledTrust(), 2, 2, 0)
    with pytest.raises(TrustboError, match="no bound enters any cell"):
        Planner(row, (0, 0), (0, 3)).trust(draws, move="n")
