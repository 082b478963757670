"""Routes against networkx, and regions that no route leaves."""

import networkx as nx
import numpy as np
import pytest

from trustbo.team import Robot
from trustbo.workspace.routes import Routes, a_star, largest_region
from trustbo.workspace.surface import Surface


def found_by_a_star(pace, pixel, start, goal):
    """Pixels of the fastest way on a map without a frame."""
    ends = [(row + 1, col + 1) for row, col in (start, goal)]
    return a_star(np.pad(pace, 1, constant_values=np.inf), pixel, *ends) - 1


def cheapest(pace, pixel, start, goal):
    """Cost of the cheapest way by networkx, with the same rule against cutting corners."""
    graph = nx.Graph()
    rows, cols = pace.shape
    for r in range(rows):
        for c in range(cols):
            for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
                i, j = r + dr, c + dc
                if not (0 <= i < rows and 0 <= j < cols):
                    continue
                if np.isfinite([pace[r, c], pace[i, j], pace[i, c], pace[r, j]]).all():
                    length = np.hypot(dr * pixel[0], dc * pixel[1])
                    graph.add_edge((r, c), (i, j), weight=0.5 * (pace[r, c] + pace[i, j]) * length)
    return nx.dijkstra_path_length(graph, start, goal)


@pytest.mark.parametrize("seed", range(10))
def test_routes_cost_what_networkx_says_is_the_least(seed):
    rng, pixel = np.random.default_rng(seed), (1.0, 1.7)
    # On even ground every estimate of the way ahead is nearly reached: one too large misleads.
    pace = rng.uniform(1.0, (1.3, 8.0)[seed % 2], (15, 20))
    pace[rng.uniform(size=pace.shape) < 0.25] = np.inf
    pace[0, 0] = pace[14, 19] = 1.0
    cells = found_by_a_star(pace, pixel, (0, 0), (14, 19))
    try:
        expected = cheapest(pace, pixel, (0, 0), (14, 19))
    except (nx.NetworkXNoPath, nx.NodeNotFound):
        assert not len(cells)
        return
    steps = np.hypot(*(np.diff(cells, axis=0) * pixel).T)
    paces = pace[cells[:, 0], cells[:, 1]]
    np.testing.assert_allclose((0.5 * (paces[1:] + paces[:-1]) * steps).sum(), expected)


def test_no_way_gives_no_route():
    passable = np.ones((60, 60), bool)
    passable[:, 30] = False
    flat = np.zeros((60, 60))
    surface = Surface(flat, flat, np.zeros((2, 60, 60)), passable, (1.0, 1.0), (0.0, 0.0))
    route = Routes(surface).find(
        Robot(), np.array([5.0, -5.0]), np.array([50.0, -5.0]), (0, 60, 0, 60)
    )
    assert route is None


def test_routes_and_regions_agree_that_corners_do_not_connect():
    passable = np.zeros((60, 60), bool)
    passable[:30, :30] = passable[30:, 30:] = True
    pace = np.where(passable, 1.0, np.inf)
    assert not len(found_by_a_star(pace, (1.0, 1.0), (5, 5), (50, 50)))
    region = largest_region(passable)
    assert region.sum() == 900
