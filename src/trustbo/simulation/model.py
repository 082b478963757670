"""Simulator that draws contact rates from a trust model, and failures from given chances."""

from collections.abc import Sequence

import jax
import numpy as np
from numpy.typing import ArrayLike

from trustbo.data import Cell, Mission
from trustbo.errors import (
    ShapeError,
    TrustboError,
    require_cells,
    require_kind,
    require_whole,
)
from trustbo.models import PooledTrust
from trustbo.models.backend import own_settings
from trustbo.models.model import TrustModel
from trustbo.models.params import Params, check_params
from trustbo.simulation.model_contact import ModelContact
from trustbo.simulation.protocol import DescribedSimulator
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES, along, moves_along


class ModelSimulator(DescribedSimulator):
    """Simulator that draws contact rates from a trust model, and failures from chances of bounds.

    Posteriors and plans of a campaign can be compared with the truth: `params` and `awareness` give
    the value of every path, `Planner.plan(params)` the best one.
    """

    def __init__(
        self,
        workspace: Workspace,
        params: Params,
        model: TrustModel | None = None,
        *,
        awareness: ArrayLike | None = None,
        n_ticks: int | None = None,
        p_fail: ArrayLike | None = None,
    ) -> None:
        """Set the true parameters, awareness and chances to fail.

        Args:
            workspace: Planning grid with awareness and passability.
            params: True parameters, one draw of them.
            model: Trust model with these parameters; by default `PooledTrust()`. Gaussian rates are
                clipped to [0, 1]: where many are, the data no longer follow the model.
            awareness: True awareness, if it differs from the workspace's, of cells (robot, row,
                col, feature) or of bounds (robot, move, row, col, feature); missions measure it
                along their path.
            n_ticks: Ticks of each bound, for `"beta_binomial"`.
            p_fail: Chance that each bound ends the mission, shape (move, row, col), such as a draw
                of `hazard.risk.BoundRisk`; robots are "stuck" then. None for no failures.

        Raises:
            ShapeError: Parameters or awareness of other robots or features, or of many draws; or
                chances of other bounds.
            TrustboError: An n_ticks that is no number of ticks, or is missing; a chance outside
                [0, 1].
        """
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        require_kind("params", params, Params, "give parameters, such as TrustParams(...)")
        self.workspace, self.params = workspace, params
        self.model = PooledTrust() if model is None else model
        shape = workspace.awareness.shape
        given = workspace.bound_maps if awareness is None else np.asarray(awareness)
        self.awareness = given[:, None] if given.ndim == 4 else given
        if self.awareness.shape not in ((shape[0], n, *shape[1:]) for n in (1, len(MOVES[8]))):
            raise ShapeError(
                f"awareness must be {shape}, or with an axis of 8 moves behind the robots; got "
                f"shape {given.shape}."
            )
        if params.leading:
            raise ShapeError(f"give one draw of params; they have leading axes {params.leading}.")
        check_params(params, shape[0], shape[3])
        self.n_ticks = None if n_ticks is None else require_whole("n_ticks", n_ticks, 1)
        if self.n_ticks is None and self.model.family.needs_ticks:
            raise TrustboError("the beta-binomial family counts ticks: give n_ticks.")
        if self.n_ticks is not None and not self.model.family.needs_ticks:
            raise TrustboError(
                f"n_ticks={self.n_ticks} is for counts, and {self.model.family.name} rates are no "
                'shares of ticks: leave it out, or give a model of observation="beta_binomial".'
            )
        self.p_fail = (
            None if p_fail is None else _require_chances(p_fail, (len(MOVES[8]), *shape[1:3]))
        )

    def run(self, path: Sequence[Cell], *, seed: int) -> Mission:
        """Run a path; the same seed gives the same mission."""
        path = require_cells("path", path)
        cells = [self.workspace.require_cell(f"path[{k}]", cell) for k, cell in enumerate(path)]
        z = np.swapaxes(along(self.awareness, cells), 0, 1)
        with own_settings():  # else the caller's flags decide what is drawn
            key = jax.random.key(require_whole("seed", seed, 0))
        params = self.params.along(cells)
        sample = self.model.simulate(key, params, z[None], self.n_ticks)
        rates = np.clip(sample.contact_rate[0], 0.0, 1.0)
        ticks = None if self.n_ticks is None else np.full(rates.shape, self.n_ticks)
        n, status = self._end(cells, seed)
        ticks = None if ticks is None else ticks[:n]
        return Mission.from_arrays(
            cells, z[:n], rates[:n], status=status, n_ticks=ticks,
            features=self.workspace.features, robots=self.workspace.team.names,
        )  # fmt: skip

    def _end(self, cells: list[Cell], seed: int) -> tuple[int, str]:
        """Number of bounds that are run, and the status that the mission ends with."""
        n = len(cells) - 1
        if self.p_fail is None:
            return n, "ok"
        rng = np.random.default_rng([seed, 1])
        chance = self.p_fail[moves_along(cells), *np.array(cells)[1:].T]
        failed = np.flatnonzero(rng.random(n) < chance)
        return (int(failed[0]) + 1, "stuck") if len(failed) else (n, "ok")

    def expected_contact(self) -> ModelContact:
        """Return the expected contact and failures of bounds, in closed form."""
        return ModelContact(self.model, self.params, self.awareness, self.p_fail)

    def describe(self) -> dict[str, object]:
        """Return the model and its true parameters."""
        truth = {n: np.asarray(value).tolist() for n, value in self.params.by_name.items()}
        about: dict[str, object] = {
            "simulator": type(self).__name__,
            "simulator_model": self.model.describe(),
            "truth": truth,
        }
        if self.p_fail is not None:
            about["p_fail"] = np.nan_to_num(self.p_fail, nan=-1.0).tolist()
        return about


def _require_chances(p_fail: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Chances to fail, NaN where there is no bound, as an array (move, row, col)."""
    chances = np.asarray(p_fail, dtype=float)
    if chances.shape != shape:
        raise ShapeError(f"p_fail must be (move, row, col) = {shape}; got {chances.shape}.")
    if (bad := (chances < 0.0) | (chances > 1.0)).any():
        raise TrustboError(f"p_fail is a chance in [0, 1]; got {chances[bad][0]:g}.")
    return chances
