"""Truth: tables against missions and closed forms, best paths against enumeration, its cache."""

import numpy as np
import pytest
import xarray as xr
from worlds import hillside

from trustbo.data import Bound
from trustbo.errors import TrustboError
from trustbo.models import CoupledTrust, HierarchicalTrust, PooledTrust
from trustbo.models.params import CoupledParams, RobotParams, TrustParams
from trustbo.planning.paths import AdmissiblePaths, PathClass
from trustbo.simulation import KinematicSimulator, ModelSimulator, Threat, Truth, truth
from trustbo.simulation.bound_table import BoundTable
from trustbo.simulation.model_contact import ModelContact
from trustbo.simulation.replicates import edges_of
from trustbo.team import Robot, Team
from trustbo.terrain import synthetic_terrain
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES, existing_bounds

PATH = ((2, 0), (1, 1), (1, 2), (0, 1))


def grid(shape=(3, 3), walls=(), n_robots=1, n_features=2, seed=0):
    z = np.random.default_rng(seed).uniform(size=(n_robots, *shape, n_features))
    passable = np.ones(shape, bool)
    for wall in walls:
        passable[wall] = False
    return Workspace.from_awareness(z, passable)


def wooded_simulator(**options):
    terrain = hillside()
    return KinematicSimulator(Workspace.from_terrain(terrain, (3, 3)), **options)


@pytest.fixture(scope="module")
def wooded():
    return wooded_simulator()


@pytest.fixture(scope="module")
def of_wooded(wooded, tmp_path_factory):
    return Truth.of(wooded, folder=tmp_path_factory.mktemp("truth"))


def walks(paths):
    """All admissible paths, by enumeration."""
    found, steps = [], MOVES[paths.connectivity]

    def extend(path):
        if path[-1] == paths.goal:
            found.append(tuple(path))
            return
        if len(path) > paths.longest:
            return
        for down, right in steps:
            cell = path[-1][0] + down, path[-1][1] + right
            inside = (
                0 <= cell[0] < paths.passable.shape[0] and 0 <= cell[1] < paths.passable.shape[1]
            )
            back = not paths.u_turns and len(path) > 1 and cell == path[-2]
            if inside and paths.passable[cell] and not back:
                extend([*path, cell])

    extend([paths.start])
    return found


# --- tables ---


def test_the_table_is_the_mean_of_many_missions(wooded, of_wooded):
    missions = wooded.run_batch(PATH, range(400))
    rates = np.mean([mission.contact_rate for mission in missions], axis=0)
    # Looks add .5 / sqrt(60 ticks x 400 missions) = .003, the table its own error; the first bound
    # begins in position, which the table averages with arrivals: .01.
    np.testing.assert_allclose(of_wooded.bounds.contact(PATH), rates, atol=0.025)
    own = of_wooded.value(PATH)
    assert own.mean == pytest.approx(rates.mean(), abs=0.01)
    assert own.lost == pytest.approx(3.0 * (1.0 - own.mean))
    assert own.p_arrive == 1.0


def test_the_standard_error_is_as_asked_for_and_that_of_other_seeds(wooded, of_wooded, tmp_path):
    assert 0.0 < of_wooded.standard_error <= 0.005
    other = Truth.of(wooded, seed=1, folder=tmp_path)
    gap = (of_wooded.bounds.data["contact"] - other.bounds.data["contact"]).mean("robot")
    # Two independent errors; replicates begin after each bound in turn, so the stated one is
    # at most too large.
    assert float((gap**2).mean() ** 0.5) < 1.3 * 2.0**0.5 * 0.005
    coarse = Truth.of(wooded, standard_error=0.05, folder=tmp_path)
    assert coarse.bounds.data["n"].max() == 3


def test_tracks_that_outlast_misses_are_simulated(tmp_path):
    robot = Robot(acquire=2, drop=3)
    terrain = hillside(60.0, 60.0)
    team = Team(robots=(robot,), lead=robot)
    simulator = KinematicSimulator(Workspace.from_terrain(terrain, (2, 2), team))
    found = Truth.of(simulator, standard_error=0.02, folder=tmp_path)
    path = ((1, 0), (0, 0), (0, 1))
    rates = np.mean([m.contact_rate for m in simulator.run_batch(path, range(300))], axis=0)
    np.testing.assert_allclose(found.bounds.contact(path), rates, atol=0.06)  # 3 errors


def test_bounds_that_fail_say_so_and_keep_no_contact(tmp_path):
    simulator = wooded_simulator(bound_timeout=5.0)  # nobody arrives in 5 s
    found = Truth.of(simulator, folder=tmp_path)
    data = found.bounds.data
    exists = existing_bounds(simulator.workspace.passable.values)
    assert (data["outcome"].sel(status="timeout").values[exists, 8] == 1.0).all()
    value = found.value(PATH)
    assert (value.lost, value.mean, value.p_arrive) == (3.0, 0.0, 0.0)


def test_the_world_of_a_mission_has_its_own_truth(tmp_path):
    workspace = wooded_simulator().workspace
    x, y = (float(workspace.terrain[axis].mean()) for axis in ("x", "y"))
    jam = Threat("jam", center=(x, y), radius=100.0, first_mission=3)
    simulator = KinematicSimulator(workspace, threats=[jam])
    before = Truth.of(simulator, standard_error=0.02, folder=tmp_path)
    assert before.at(2) is before
    assert before.at(3) is before.at(7)
    assert before.at(3).value(PATH).mean == 0.0
    assert before.value(PATH).mean > 0.3


class Plain:
    """Simulator of a user: contact .2 along rows, .8 otherwise; alone if it goes on to the east."""

    def __init__(self, workspace):
        self.workspace, self.runs = workspace, 0

    def describe(self):
        return {"simulator": "plain"}

    def run(self, path, *, seed):
        raise NotImplementedError

    def reset(self, start, seed):
        self.here, self.rng = start, np.random.default_rng(seed)

    def run_bound(self, k, cell, *, next_cell=None):
        self.runs += 1
        rate = 0.2 if cell[0] == self.here[0] else 0.8
        rate = 0.0 if next_cell == (cell[0], cell[1] + 1) else rate
        noise = 0.05 * self.rng.uniform(-1.0, 1.0) if rate else 0.0
        return Bound(cell, np.full((1, 2), np.nan), np.array([rate + noise]), np.array([9.0]))


def test_any_simulator_of_bounds_has_a_truth(tmp_path):
    simulator = Plain(grid((2, 3)))
    found = Truth.of(simulator, folder=tmp_path)
    rates = found.bounds.contact([(0, 0), (1, 0), (1, 1), (1, 2), (0, 2)])[:, 0]
    np.testing.assert_allclose(rates, [0.0, 0.0, 0.2, 0.8], atol=0.02)  # 4 errors
    assert found.standard_error <= 0.005


# --- cache ---


def test_a_truth_is_found_once(of_wooded, wooded, tmp_path, monkeypatch):
    simulator = Plain(grid((2, 2)))
    first = Truth.of(simulator, folder=tmp_path)
    monkeypatch.setattr(truth, "tabulate", None)  # would be an error
    again = Truth.of(Plain(grid((2, 2))), folder=tmp_path)
    xr.testing.assert_equal(again.bounds.data, first.bounds.data)
    for changed in (Plain(grid((2, 3))), Plain(grid((2, 2), seed=1))):
        with pytest.raises(TypeError):
            Truth.of(changed, folder=tmp_path)
    with pytest.raises(TypeError):
        Truth.of(simulator, folder=tmp_path, seed=1)
    (file,) = tmp_path.glob("*.nc")
    file.write_bytes(b"damaged")
    with pytest.raises(TypeError):  # found anew
        Truth.of(simulator, folder=tmp_path)


# --- best paths ---


@pytest.mark.parametrize("objective", ["lost_contact", "mean"])
@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("max_bounds", ["shortest", "shortest+2", 6])
def test_the_best_path_is_that_of_enumeration(objective, connectivity, max_bounds):
    rng = np.random.default_rng(3)
    for seed in range(4):
        workspace = grid((3, 4), walls=[(1, seed)])
        shape = 2, 8, 3, 4, 9
        contact = np.full(shape, np.nan)
        for edge in edges_of(workspace):
            for n in edge.next_moves:
                contact[:, edge.move, *edge.cell, n] = rng.uniform(size=2)
        dims = ("robot", "move", "row", "col", "next_move")
        outcome = np.ones((1, *shape[1:]))
        table = BoundTable(
            xr.Dataset(
                {"contact": (dims, contact), "outcome": (("status", *dims[1:]), outcome)},
                {"status": ["ok"]},
            )
        )
        known = Truth(workspace, table)
        ends = (2, 0), (0, 3) if seed < 3 else (1, 2)
        paths = AdmissiblePaths(workspace, *ends, PathClass(connectivity, max_bounds))
        options = {"objective": objective, "max_bounds": max_bounds, "connectivity": connectivity}
        best = known.best(*ends, **options)
        values = {path: known.value(path) for path in walks(paths)}
        assert best in values
        if objective == "mean":
            most = max(value.mean for value in values.values())
            assert values[best].mean == pytest.approx(most, rel=1e-12)
        else:
            least = min(value.lost for value in values.values())
            assert values[best].lost == pytest.approx(least, rel=1e-12)
        other = next(iter(values))
        kept = len(best) - 1 - values[best].lost
        lacking = (values[other].lost - values[best].lost) / kept
        if objective == "mean":
            lacking = 1.0 - values[other].mean / values[best].mean
        assert known.regret(other, **options) == pytest.approx(100.0 * lacking)
        assert known.regret(best, **options) == 0.0


# --- models ---

PARAMS = {
    "pooled": TrustParams(0.6, np.array([0.5, -0.4]), 0.3, 0.1, 0.15),
    "robots": RobotParams(
        np.array([0.3, 0.7]), np.array([[0.5, 0.2], [0.1, 0.3]]), np.array([0.2, 0.1]),
        np.array([0.1, 0.2]), np.array([0.15, 0.1]),
    ),
    "coupled": CoupledParams(
        np.array([[0.4, 0.1], [0.2, 0.3]]), np.full((2, 2, 2), 0.1), np.array([0.2, 0.3]),
        np.array([[0.02, 0.01], [0.01, 0.03]]), 0.02 * np.eye(2),
    ),
    "counts": TrustParams(0.6, np.array([2.0, -2.0]), 0.5, 0.8, 0.3, 0.0, 1.5),
}  # fmt: skip
MODELS = {
    "pooled": PooledTrust(),
    "robots": HierarchicalTrust(),
    "coupled": CoupledTrust(),
    "counts": PooledTrust(observation="beta_binomial"),
}


def drawn_rates(workspace, p, counts, n=100_000):
    """Rates of many missions along PATH by equations (1) and (2), shape (mission, bound, robot)."""
    rng = np.random.default_rng(0)
    if isinstance(p, CoupledParams):
        B0, B, b, cov_w, cov_v = p[:5]
    else:
        B0, cov_w, cov_v = (
            np.eye(2) * np.asarray(v) for v in (p.beta0, p.delta_w**2, p.delta_v**2)
        )
        B = np.moveaxis(np.asarray(p.beta) * np.ones((2, 2)), -1, 0)[..., None] * np.eye(2)
        b = np.asarray(p.b) * np.ones(2)
    x, rates = p.x0_mean + p.x0_sd * rng.normal(size=(n, 2)), []
    for cell in PATH[1:]:
        z = workspace.awareness.values[:, *cell]  # (robot, feature)
        noise = rng.multivariate_normal(np.zeros(2), cov_w, n)
        x = x @ B0.T + np.einsum("mai,im->a", B, z) + b + noise
        seen = rng.multivariate_normal(np.zeros(2), cov_v, n)
        rates.append(1.0 / (1.0 + np.exp(-x)) if counts else np.clip(x + seen, 0.0, 1.0))
    return np.stack(rates, axis=1)


@pytest.mark.parametrize("name", MODELS)
def test_a_model_s_truth_is_the_mean_of_its_missions(name):
    workspace, params = grid(n_robots=2), PARAMS[name]
    n_ticks = 50 if name == "counts" else None
    found = Truth.of(ModelSimulator(workspace, params, MODELS[name], n_ticks=n_ticks))
    drawn, n = drawn_rates(workspace, params, counts=name == "counts"), 100_000
    # Counts are drawn as their probabilities; all by (1) and (2), 4 standard errors.
    error = drawn.std(0) / n**0.5
    np.testing.assert_array_less(np.abs(found.bounds.contact(PATH) - drawn.mean(0)), 4.0 * error)
    assert found.standard_error == 0.0
    assert found.at(5) is found
    assert found.value(PATH).p_arrive == 1.0


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("objective", ["lost_contact", "mean"])
@pytest.mark.parametrize("max_bounds", ["shortest+2", 5])
def test_a_model_s_best_path_is_that_of_enumeration(name, objective, max_bounds):
    for seed in range(3):
        workspace = grid((3, 4), walls=[(1, 1)], n_robots=2, seed=seed)
        known = Truth(workspace, ModelContact(MODELS[name], PARAMS[name], workspace.bound_maps))
        ends = (2, 0), (0, 3)
        best = known.best(*ends, objective, max_bounds)
        paths = AdmissiblePaths(workspace, *ends, PathClass(8, max_bounds))
        values = [known.value(path) for path in walks(paths)]
        if objective == "mean":
            most = max(value.mean for value in values)
            assert known.value(best).mean == pytest.approx(most, rel=1e-12)
        else:
            least = min(value.lost for value in values)
            assert known.value(best).lost == pytest.approx(least, rel=1e-12)


# --- refusals ---


def test_impossible_truths_are_refused(of_wooded, wooded):
    with pytest.raises(TrustboError, match="needs a simulator with a workspace; object has none"):
        Truth.of(object())
    with pytest.raises(TrustboError, match="Bare has no reset and no run_bound"):
        Truth.of(type("Bare", (), {"workspace": grid(), "run": None})())
    with pytest.raises(TrustboError, match="standard_error must be positive and finite; got 0"):
        Truth.of(wooded, standard_error=0)
    with pytest.raises(TrustboError, match="unknown objective of a truth 'terminal'"):
        of_wooded.best((2, 0), (0, 2), "terminal")
    with pytest.raises(TrustboError, match=r"no bound leads from \(2, 0\) to \(0, 2\)"):
        of_wooded.value([(2, 0), (0, 2)])
    with pytest.raises(TrustboError, match="a path needs at least two cells"):
        of_wooded.regret([(2, 0)])
    falling = ModelSimulator(grid(), PARAMS["pooled"]._replace(beta0=-0.5))
    with pytest.raises(TrustboError, match="trust that rises with the trust before it"):
        Truth.of(falling).best((2, 0), (0, 2), max_bounds="shortest")


def test_a_truth_of_another_workspace_is_refused(of_wooded, wooded):
    of_wooded.require_workspace(wooded.workspace)
    with pytest.raises(TrustboError, match="the truth is of another workspace: its grid is"):
        of_wooded.require_workspace(grid())
    terrain = synthetic_terrain((90.0, 90.0), seed=6, relief=6.0)
    with pytest.raises(TrustboError, match="of another workspace: its dem is of mean height"):
        of_wooded.require_workspace(Workspace.from_terrain(terrain, (3, 3)))
    with pytest.raises(TrustboError, match="its passability is 9 passable cells, the campaign's 8"):
        Truth(grid(), of_wooded.bounds).require_workspace(grid(walls=[(1, 1)]))
