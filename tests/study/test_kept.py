"""Contact and failures in one unit: paths and the best of them, by writing out all paths."""

import itertools

import numpy as np
import pytest
from worlds import random_cells

from trustbo.models import PooledTrust
from trustbo.models.params import TrustParams
from trustbo.planning.paths import AdmissiblePaths, PathClass
from trustbo.simulation import ModelSimulator, Truth
from trustbo.simulation.bound_table import table_of
from trustbo.simulation.replicates import edges_of
from trustbo.study.kept import expected_loss, least_loss, most_kept
from trustbo.workspace.moves import MOVES

ENDS = (2, 0), (0, 2)


def random_truth(seed, *, fails=True):
    """Truth of 3 x 3 cells whose bounds have random contact, and fail, always or at times."""
    workspace, rng = random_cells(n=3), np.random.default_rng(seed)
    contact = np.full((3, 8, 3, 3, 9), np.nan)
    passed = np.full(contact.shape[1:], np.nan)
    for edge in edges_of(workspace):
        for after in edge.next_moves:
            contact[:, edge.move, *edge.cell, after] = rng.uniform(size=3)
            chance = rng.choice([1.0, 0.0, rng.uniform()]) if fails else 1.0
            passed[edge.move, *edge.cell, after] = chance
    return Truth(workspace, table_of(workspace, contact, passed[None], np.zeros(passed.shape)))


def all_paths(paths):
    """All admissible paths, written out."""
    steps, found = MOVES[paths.connectivity], []
    begun = [(paths.start,)]
    while begun:
        path = begun.pop()
        for down, right in steps:
            cell = path[-1][0] + down, path[-1][1] + right
            back = len(path) > 1 and cell == path[-2] and not paths.u_turns
            if not (0 <= cell[0] < 3 and 0 <= cell[1] < 3) or back:
                continue
            if cell == paths.goal:
                found.append((*path, cell))
            elif len(path) < paths.longest:
                begun.append((*path, cell))
    return found


def loss_by_hand(truth, path):
    """Walk along a path, bound by bound."""
    data, reached, loss = truth.bounds.data, 1.0, 0.0
    moves = [MOVES[8].index((b[0] - a[0], b[1] - a[1])) for a, b in itertools.pairwise(path)]
    for move, cell, after in zip(moves, path[1:], [*moves[1:], 8], strict=True):
        where = {"move": move, "row": cell[0], "col": cell[1], "next_move": after}
        reached *= float(data["outcome"].isel(status=0, **where))
        loss += 1.0 - reached * float(data["contact"].isel(where).mean())
    return loss


@pytest.mark.parametrize("admitted", [(8, "shortest+2"), (8, 4), (4, "shortest+2"), (4, 6)])
@pytest.mark.parametrize("seed", range(5))
def test_the_least_loss_is_that_of_the_best_of_all_paths(admitted, seed):
    truth = random_truth(seed)
    paths = AdmissiblePaths(truth.workspace, *ENDS, PathClass(*admitted))
    losses = [expected_loss(truth, path) for path in all_paths(paths)]
    by_hand = [loss_by_hand(truth, path) for path in all_paths(paths)]
    np.testing.assert_allclose(losses, by_hand, rtol=1e-12)
    assert least_loss(truth, paths) == pytest.approx(min(losses), rel=1e-12)


def test_the_most_contact_is_kept_for_each_number_of_bounds():
    truth = random_truth(9)
    paths = AdmissiblePaths(truth.workspace, *ENDS, PathClass(8, "shortest+2"))
    data = truth.bounds.data
    passed = data["outcome"].sel(status="ok").values
    most = most_kept(data["contact"].values.mean(0), passed, paths)
    expected = np.full(paths.longest, -np.inf)
    for path in all_paths(paths):
        n = len(path) - 1
        expected[n - 1] = max(expected[n - 1], n - loss_by_hand(truth, path))
    np.testing.assert_allclose(most, expected, rtol=1e-12)
    assert most[0] == -np.inf  # no path of one bound


def test_where_nothing_fails_losses_are_those_of_the_truth():
    truth = random_truth(3, fails=False)
    paths = AdmissiblePaths(truth.workspace, *ENDS, PathClass(8, "shortest+2"))
    best = truth.best(*ENDS, max_bounds="shortest+2")
    assert least_loss(truth, paths) == pytest.approx(truth.value(best).lost, rel=1e-12)
    for path in all_paths(paths)[:10]:
        assert expected_loss(truth, path) == pytest.approx(truth.value(path).lost, rel=1e-12)


def test_a_truth_in_closed_form_has_the_loss_of_its_best_path():
    workspace = random_cells(n=3)
    params = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05, 0.5, 0.1)
    truth = Truth.of(ModelSimulator(workspace, params, PooledTrust()))
    paths = AdmissiblePaths(workspace, *ENDS, PathClass(8, "shortest+2"))
    best = min(truth.value(path).lost for path in all_paths(paths))
    assert least_loss(truth, paths) == pytest.approx(best, rel=1e-9)
