"""Simulator that draws missions from a trust model instead of moving robots."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from trustbo.arrays import read_labelled
from trustbo.data import Cell, Mission, Station
from trustbo.errors import TrustboError, require_kind, require_whole
from trustbo.hazard.given import read_risk
from trustbo.identity import fingerprint
from trustbo.models import PooledTrust
from trustbo.models.draws import Draws
from trustbo.models.model import TrustModel
from trustbo.simulation.protocol import DescribedSimulator, require_path
from trustbo.statespace import kalman
from trustbo.streams import stream
from trustbo.workspace import Workspace
from trustbo.workspace.moves import along, bounds_along, next_names, pairs_along, way_names

_STREAM = 0x6D697373  # makes the random numbers differ from others with the same seed


class ModelSimulator(DescribedSimulator):
    """Simulator that draws contact rates from a trust model, and failures from given probabilities.

    Because the true parameters are known, posteriors and plans of a campaign can be compared with
    the truth: `Planner.plan(params)` and, for a given path, `Planner.evaluate(path, params)`.

    Example:
        >>> truth = tb.inference.params_of(posterior, workspace).draw(0)
        >>> simulator = tb.simulation.ModelSimulator(workspace, truth)
        >>> tb.iterate(workspace, (9, 0), (0, 9), n_iterations=1, simulator=simulator)
    """

    def __init__(
        self,
        workspace: Workspace,
        params: Draws,
        model: TrustModel | None = None,
        *,
        awareness: ArrayLike | None = None,
        n_ticks: int | None = None,
        p_fail: ArrayLike | None = None,
    ) -> None:
        """Set the true parameters, awareness and failure probabilities.

        Args:
            workspace: Planning grid with awareness and passability.
            params: True parameters, as a single draw.
            model: Trust model with these parameters; by default `PooledTrust()`. Gaussian rates are
                clipped to [0, 1]; if many rates are clipped, the data do not follow the model.
            awareness: True awareness, shape (robot, move, row, col, feature), which missions
                measure along their paths; by default the workspace's awareness.
            n_ticks: Number of ticks of each bound; used only by the beta-binomial family, which
                needs it.
            p_fail: Probability that a bound fails, as in `Planner.with_risk`, such as a draw of
                `hazard.BoundRisk`. Failed bounds are "stuck". By default, no bound fails.

        Raises:
            TrustboError: The robots or features of the parameters or awareness do not match the
                workspace's, there are several draws, `p_fail` has the wrong shape or is outside
                [0, 1], or `n_ticks` is missing or not used.
        """
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        require_kind("params", params, Draws, "give parameters, such as TrustParams(...)")
        self.workspace = workspace
        self.params = params = params.in_order(workspace.team.names, workspace.features)
        self.model = PooledTrust() if model is None else model

        shape = workspace.awareness.shape
        self.awareness = workspace.awareness.values
        if awareness is not None:
            self.awareness = read_labelled("awareness", awareness, *_labels_of(workspace)).values
        if self.awareness.shape != shape:
            raise TrustboError(f"awareness must have shape {shape}; got {self.awareness.shape}.")

        if params.n_draws > 1:
            raise TrustboError(f"params must be a single draw; got {params.n_draws}.")
        params.require_valid(shape[0], shape[-1])

        self.n_ticks = None if n_ticks is None else require_whole("n_ticks", n_ticks, 1)
        if (self.n_ticks is not None) != self.model.likelihood.needs_ticks:
            needs = "needs" if self.model.likelihood.needs_ticks else "does not use"
            raise TrustboError(
                f"family {self.model.likelihood.name!r} {needs} n_ticks; got {n_ticks}."
            )

        self.p_fail = None if p_fail is None else _require_probabilities(p_fail, workspace)

    def run(
        self,
        path: Sequence[Cell],
        *,
        seed: int,
        mission: int = 0,
        post_sets: Sequence[str] = (),
    ) -> Mission:
        """Run a path; the result depends on the seed, but not on the number of the mission."""
        cells = require_path(self.workspace, path, post_sets)
        z = along(self.awareness, cells)  # (robot, bound, feature)
        n_robots, n_bounds = z.shape[:2]
        # Without _STREAM, seed 0 would give the same numbers as `default_rng(0)`.
        rng = np.random.default_rng([0, require_whole("seed", seed, 0), _STREAM])

        params = self.params
        space = params.state_space(n_robots, adds_noise=self.model.likelihood.adds_noise)
        inputs = params.along(z, bounds_along(cells), space)

        offset = params.initial_offset[:, None, None]
        start = kalman.initial(space, n_robots // space.n_members, offset)
        counts = np.full((n_bounds, n_robots), np.nan if self.n_ticks is None else self.n_ticks)
        ticks = space.grouped(counts)
        drawn = kalman.forecast(space, start, inputs, ticks, self.model.likelihood, rng)
        rates = np.clip([of_robots[0] for _, of_robots in drawn], 0.0, 1.0)

        n, status = self._end(cells, seed)
        return Mission.from_arrays(
            cells,
            np.swapaxes(z, 0, 1)[:n],
            rates[:n],
            status=status,
            n_ticks=None if self.n_ticks is None else counts[:n],
            features=self.workspace.features,
            robots=self.workspace.team.names,
        )

    def describe(self) -> dict[str, object]:
        """Return the settings that affect the measurements of a mission."""
        about: dict[str, object] = {
            "simulator": type(self).__name__,
            "simulator_model": self.model.in_short(),
            "truth": self.params.record(),
        }
        if self.n_ticks is not None:
            about["n_ticks"] = self.n_ticks
        if not np.array_equal(self.awareness, self.workspace.awareness.values, equal_nan=True):
            about["true_awareness"] = fingerprint(self.awareness)
        if self.p_fail is not None:
            about["p_fail"] = np.nan_to_num(self.p_fail, nan=-1.0).tolist()
        return about

    def _end(self, cells: Sequence[Station], seed: int) -> tuple[int, str]:
        """Return the number of bounds that the team starts, and the status of the mission."""
        n = len(cells) - 1
        if self.p_fail is None:
            return n, "ok"
        rng = stream(seed, "failures")
        p = self.p_fail[*pairs_along(cells, self.workspace.n_posts).T]
        failed = np.flatnonzero(rng.random(n) < p)
        return (int(failed[0]) + 1, "stuck") if len(failed) else (n, "ok")


def _labels_of(workspace: Workspace) -> tuple[tuple[str, ...], dict[str, tuple[str, ...]]]:
    """Return the dims of a workspace's awareness, and the names along them."""
    ways = tuple(way_names(workspace.n_posts))
    names = {"robot": workspace.team.names, "move": ways, "feature": workspace.features}
    return tuple(str(dim) for dim in workspace.awareness.dims), names


def _require_probabilities(p_fail: ArrayLike, workspace: Workspace) -> np.ndarray:
    """Check failure probabilities, and return them as (way, row, col, next_way)."""
    p = read_risk("p_fail", p_fail, (), workspace.n_posts)
    shape = workspace.awareness.shape[1:4]
    n_next = len(next_names(workspace.n_posts))
    if p.shape != (*shape, n_next):
        raise TrustboError(
            f"p_fail must have the shape (move, row, col) = {shape}, or that with a last axis "
            f"next_move of length {n_next}; got {np.shape(p_fail)}."
        )
    bad = (p < 0.0) | (p > 1.0)
    if bad.any():
        raise TrustboError(f"p_fail must be in [0, 1]; got {p[bad][0]:g}.")
    return p
