"""Awareness of given ways on a terrain, such as roads, in place of those between cells."""

from collections.abc import Sequence
from itertools import batched

import numpy as np
import shapely

from trustbo.data import is_line_of_sight
from trustbo.errors import TrustboError
from trustbo.workspace.bound_awareness import TRAVERSABLE
from trustbo.workspace.line_of_sight import N_SAMPLES, Geometry, bound_features
from trustbo.workspace.workspace import Workspace

_BLOCK = 256  # ways computed at a time, which bounds the memory


def awareness_of_ways(workspace: Workspace, ways: Sequence[np.ndarray]) -> np.ndarray:
    """Compute the workspace's features on ways (point, 2), CRS metres: (way, robot, feature).

    T2 stands where a way begins and watches the lead drive it, then closes up along it. Line of
    sight is that of these bounds, traversability the mean along the way, and other features are
    those of the cell where it ends. TrustboError: no terrain in memory; a way that leaves it, or
    ends in a cell without data.
    """
    surface, pixels = workspace.surface, workspace.pixels
    if surface is None or pixels is None or not workspace.sights:
        raise TrustboError(
            "awareness of roads needs a terrain in memory and an assumed sight; make the workspace "
            "by Workspace.from_terrain."
        )
    left, bottom, right, top = surface.extent
    for way in ways:
        outside = (way < (left, bottom)) | (way > (right, top))
        if outside.any():
            x, y = way[np.argmax(outside.any(1))]
            raise TrustboError(
                f"a road leads through x {x:.1f}, y {y:.1f}, off the terrain, x {left:.1f} to "
                f"{right:.1f}, y {bottom:.1f} to {top:.1f}; give frame=export.Frame(...) "
                "with the origin and rotation in the frame.yaml beside the file."
            )
    awareness = _at_ends(workspace, ways)
    easy = np.full(surface.ground.shape, np.nan)
    if TRAVERSABLE in workspace.features:
        easy = pixels[TRAVERSABLE].values
    blocks = []
    for block in batched(ways, _BLOCK):
        lines = [shapely.segmentize(shapely.LineString(way), min(surface.pixel)) for way in block]
        given = _geometry(
            [shapely.get_coordinates(line) for line in lines], workspace.team.n_robots
        )
        of_sights = [
            bound_features(surface, sight, workspace.team, given, easy)
            for sight in workspace.sights
        ]
        blocks.append([np.stack([los for los, _ in of_sights]), of_sights[0][1]])
    seen, mean_easy = (np.concatenate(parts, axis=-2) for parts in zip(*blocks, strict=True))
    sights = iter(seen)
    for m, name in enumerate(workspace.features):
        if is_line_of_sight(name):
            awareness[..., m] = next(sights)
        elif name == TRAVERSABLE:
            awareness[..., m] = np.where(np.isfinite(mean_easy), mean_easy, awareness[..., m])
    return np.clip(awareness, 0.0, 1.0)


def _geometry(ways: list[np.ndarray], n_robots: int) -> Geometry:
    first, last = (np.stack([way[end] for way in ways]) for end in (0, -1))
    posts = np.repeat(first[:, None], n_robots, axis=1)
    ends = np.broadcast_to(last[:, None, None], (len(ways), N_SAMPLES, n_robots, 2))
    return Geometry(ways, posts, ways, posts, ends, last, False, np.arange(len(ways)))


def _at_ends(workspace: Workspace, ways: Sequence[np.ndarray]) -> np.ndarray:
    """Awareness of the cells where ways end, (way, robot, feature)."""
    cells = [workspace.grid.cell_at(*way[-1].tolist()) for way in ways]
    awareness = workspace.awareness.values[:, *np.array(cells).T].swapaxes(0, 1).copy()
    if (missing := np.isnan(awareness).any((1, 2))).any():
        k = int(np.argmax(missing))
        raise TrustboError(
            f"a road ends at x {ways[k][-1, 0]:.1f}, y {ways[k][-1, 1]:.1f}, in cell {cells[k]}, "
            "whose awareness is not known; take smaller cells, or a team with a larger max_slope."
        )
    return awareness
