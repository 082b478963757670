"""Simulator that draws contact rates from a trust model: the true parameters are known."""

from collections.abc import Sequence

import jax
import numpy as np
from numpy.typing import ArrayLike

from trustbo.data import Cell, Mission
from trustbo.errors import ShapeError, TrustboError, require_whole
from trustbo.models import PooledTrust, TrustModel
from trustbo.models.backend import own_settings
from trustbo.models.params import Params, check_params
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES, along, moves_along

_BUCKET = 8  # bounds: missions of about the same length share compiled code


class ModelSimulator:
    """Simulator that draws contact rates from a trust model with given parameters.

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
    ) -> None:
        """Set the true parameters and awareness.

        Args:
            workspace: Planning grid with awareness and passability.
            params: True parameters, one draw of them.
            model: Trust model with these parameters; by default `PooledTrust()`. Gaussian rates are
                clipped to [0, 1]: where many are, the data no longer follow the model.
            awareness: True awareness, if it differs from the workspace's, of cells (robot, row,
                col, feature) or of bounds (robot, move, row, col, feature); missions measure it
                along their path.
            n_ticks: Ticks of each bound, for `"beta_binomial"`.

        Raises:
            ShapeError: Parameters or awareness of other robots or features, or of many draws.
            TrustboError: An n_ticks that is no number of ticks, or is missing.
        """
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

    def run(self, path: Sequence[Cell], *, seed: int) -> Mission:
        """Run a path; the same seed gives the same mission."""
        cells = [self.workspace.require_cell(f"path[{k}]", cell) for k, cell in enumerate(path)]
        z = np.swapaxes(along(self.awareness, cells), 0, 1)
        n_bounds = len(z)
        padded = np.concatenate([z, np.repeat(z[-1:], -n_bounds % _BUCKET, axis=0)])
        with own_settings():  # else the caller's flags decide what is drawn
            key = jax.random.key(seed)
        bounds = np.full((1, len(padded), 3), -1)
        bounds[0, :n_bounds] = np.column_stack([moves_along(cells), np.asarray(cells)[1:]])
        sample = self.model.simulate(key, self.params.on(bounds), padded[None], self.n_ticks)
        rates = np.clip(sample.contact_rate[0, :n_bounds], 0.0, 1.0)
        ticks = None if self.n_ticks is None else np.full(rates.shape, self.n_ticks)
        features, robots = self.workspace.features, self.workspace.team.names
        return Mission.from_arrays(cells, z, rates, n_ticks=ticks, features=features, robots=robots)

    def describe(self) -> dict[str, object]:
        """Return the model and its true parameters."""
        fields = self.params._asdict().items()
        truth = {n: np.asarray(value).tolist() for n, value in fields if value is not None}
        return {
            "simulator": type(self).__name__,
            "simulator_model": self.model.describe(),
            "truth": truth,
        }
