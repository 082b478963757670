"""What is believed of the awareness map: a Gaussian process, against its conditional by hand."""

import numpy as np
import pytest

from trustbo.data import Mission
from trustbo.errors import ShapeError, TrustboError
from trustbo.workspace import AwarenessBelief, Workspace

SHAPE = (3, 4)
PATH = ((2, 0), (1, 1), (0, 2), (0, 3))


def make_workspace(level=0.5, n_robots=2, passable=None):
    return Workspace.from_awareness(np.full((n_robots, *SHAPE, 2), level), passable)


def mission(awareness):
    awareness = np.asarray(awareness, dtype=float)
    return Mission.from_arrays(PATH, awareness, np.full(awareness.shape[:2], 0.5))


def measured(rng, n_robots=2):
    return rng.uniform(0.4, 0.6, size=(len(PATH) - 1, n_robots, 2))


def conditional(cells, seen, errors, sd, length_scale, noise):
    """Mean and covariance of the errors in `cells`, given those measured in `seen`."""

    def kernel(a, b):
        r = np.linalg.norm(np.subtract(a[:, None], b[None]), axis=-1) * np.sqrt(3) / length_scale
        return sd**2 * (1.0 + r) * np.exp(-r)

    cells, seen = np.asarray(cells, dtype=float), np.asarray(seen, dtype=float)
    gain = kernel(cells, seen) @ np.linalg.inv(kernel(seen, seen) + noise**2 * np.eye(len(seen)))
    return gain @ errors, kernel(cells, cells) - gain @ kernel(seen, cells)


@pytest.fixture
def scales():
    return {"sd": 0.05, "length_scale": 1.7, "noise": 0.02}


def test_it_is_the_gaussian_conditional_of_a_matern_field(scales):
    belief, rng = AwarenessBelief(make_workspace(), **scales), np.random.default_rng(0)
    first, second = measured(rng), measured(rng)
    for z in (first, second):  # the same cells twice: both measurements count
        belief.update(mission(z))
    errors = np.concatenate([first, second]).mean(1) - 0.5  # over robots
    cells = np.argwhere(np.ones(SHAPE))
    for m in range(2):
        mean, cov = conditional(cells, [*PATH[1:], *PATH[1:]], errors[:, m], **scales)
        np.testing.assert_allclose(belief.mean()[0, ..., m].ravel(), 0.5 + mean, rtol=1e-6)
        sd = belief.sd()[..., m].ravel()
        np.testing.assert_allclose(sd, np.sqrt(np.diag(cov)), rtol=1e-6)
    assert belief.n_measured == [6, 6]


def test_before_any_measurement_it_is_the_map_give_or_take_its_sd(scales):
    belief = AwarenessBelief(make_workspace(0.3), **scales)
    np.testing.assert_array_equal(belief.mean(), 0.3)
    np.testing.assert_allclose(belief.sd(), 0.05)
    assert belief.n_measured == [0, 0]


def test_draws_have_the_conditional_s_mean_and_covariance(scales):
    belief, n = AwarenessBelief(make_workspace(), **scales), 20_000
    z = measured(np.random.default_rng(1))
    belief.update(mission(z))
    drawn = belief.draw(n, seed=2)
    assert drawn.shape == (n, 2, *SHAPE, 2)
    np.testing.assert_array_equal(drawn[:, 0], drawn[:, 1])  # robots share the error
    cells = np.argwhere(np.ones(SHAPE))
    for m in range(2):
        mean, cov = conditional(cells, PATH[1:], z.mean(1)[:, m] - 0.5, **scales)
        errors = drawn[:, 0, ..., m].reshape(n, -1) - 0.5
        var = np.diag(cov)
        assert (np.abs(errors.mean(0) - mean) < 5 * np.sqrt(var / n)).all()
        error_of_cov = np.sqrt((np.outer(var, var) + cov**2) / n)
        assert (np.abs(np.cov(errors.T) - cov) < 5 * error_of_cov).all()
    # Features have errors of their own.
    both = np.corrcoef(drawn[:, 0, 2, 0].T)
    assert abs(both[0, 1]) < 5 / np.sqrt(n)


def test_what_was_not_measured_is_left_out(scales):
    rng = np.random.default_rng(3)
    z = measured(rng)
    z[0, 0, 0] = np.nan  # one robot of two: the other's counts
    z[1, :, 1] = np.nan  # no robot: the bound does not count
    belief = AwarenessBelief(make_workspace(), **scales)
    belief.update(mission(z))
    assert belief.n_measured == [3, 2]
    cells = np.argwhere(np.ones(SHAPE))
    mean, _ = conditional(cells, PATH[1:], np.nanmean(z[..., 0], axis=1) - 0.5, **scales)
    np.testing.assert_allclose(belief.mean()[1, ..., 0].ravel(), 0.5 + mean, rtol=1e-6)
    seen = [PATH[1], PATH[3]]
    mean, _ = conditional(cells, seen, z[[0, 2], :, 1].mean(1) - 0.5, **scales)
    np.testing.assert_allclose(belief.mean()[1, ..., 1].ravel(), 0.5 + mean, rtol=1e-6)
    blind = AwarenessBelief(make_workspace(), **scales)
    blind.update(mission(np.full_like(z, np.nan)))
    assert blind.n_measured == [0, 0]
    np.testing.assert_array_equal(blind.mean(), 0.5)


def test_robots_keep_the_differences_between_their_maps():
    rng = np.random.default_rng(4)
    own = rng.uniform(0.3, 0.7, size=(2, *SHAPE, 2))
    belief = AwarenessBelief(Workspace.from_awareness(own), sd=0.03)
    z = np.swapaxes(own[:, *zip(*PATH[1:], strict=True)], 0, 1) + 0.02
    belief.update(mission(z))
    for maps in (belief.mean(), belief.draw(3)[2]):
        np.testing.assert_allclose(maps[1] - maps[0], own[1] - own[0], atol=1e-12)


def test_awareness_stays_a_share():
    drawn = AwarenessBelief(make_workspace(0.95), sd=0.5).draw(200)
    assert drawn.min() == 0.0
    assert drawn.max() == 1.0


def test_impassable_cells_are_left_as_they_are():
    passable = np.ones(SHAPE, bool)
    passable[1, 2], passable[2, 3] = False, False
    z = np.full((2, *SHAPE, 2), 0.5)
    z[:, 2, 3] = np.nan
    belief = AwarenessBelief(Workspace.from_awareness(z, passable))
    belief.update(mission(measured(np.random.default_rng(5))))
    for maps in (belief.mean()[None], belief.draw(4)):
        np.testing.assert_array_equal(maps[:, :, 1, 2], 0.5)
        assert np.isnan(maps[:, :, 2, 3]).all()
        assert not np.isnan(maps[:, :, passable]).any()
    np.testing.assert_array_equal(np.isnan(belief.sd()[..., 0]), ~passable)


def test_the_same_seed_draws_the_same_maps():
    belief = AwarenessBelief(make_workspace())
    np.testing.assert_array_equal(belief.draw(3, seed=7), belief.draw(3, seed=7))
    assert (belief.draw(3, seed=7) != belief.draw(3, seed=8)).any()


@pytest.mark.parametrize("name", ["sd", "length_scale", "noise"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.inf, "wide"])
def test_scales_are_positive(name, value):
    with pytest.raises(TrustboError, match=f"{name} must be positive and finite; got"):
        AwarenessBelief(make_workspace(), **{name: value})


def test_a_mission_of_others_is_refused():
    belief = AwarenessBelief(make_workspace())
    with pytest.raises(ShapeError, match=r"measured \(robot, feature\) \(3, 2\), the workspace "):
        belief.update(mission(np.full((3, 3, 2), 0.5)))
    off = Mission.from_arrays([(0, 0), (0, 4)], np.full((1, 2, 2), 0.5), np.full((1, 2), 0.5))
    with pytest.raises(TrustboError, match=r"enters \(0, 4\), outside the grid of 3 rows and 4 "):
        belief.update(off)
    assert belief.n_measured == [0, 0]


def test_a_grid_too_large_is_refused_with_a_remedy():
    workspace = Workspace.from_awareness(np.full((1, 64, 64, 1), 0.5))
    with pytest.raises(TrustboError, match=r"has 4096\. Use larger cells, or awareness='map'"):
        AwarenessBelief(workspace)
