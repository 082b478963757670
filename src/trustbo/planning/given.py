"""The argument `params` of a planner: a posterior or parameters, for the robots of a workspace."""

import xarray as xr

from trustbo.errors import require_kind
from trustbo.inference.learner import next_mission_of
from trustbo.models.draws import Draws, NextMission
from trustbo.workspace import Workspace


def draws_of(params: Draws | xr.DataTree, workspace: Workspace) -> NextMission:
    """Return the draws of a posterior for the next mission; parameters are used as they are.

    The features and robots are reordered by name to match the workspace, if they have names.
    Raises TrustboError if the type, the features or the robots are wrong.
    """
    if isinstance(params, xr.DataTree):
        return next_mission_of(params, workspace)

    remedy = "give a posterior from fit, or parameters"
    draws: Draws = require_kind("posterior", params, Draws, remedy)
    draws = draws.in_order(workspace.team.names, workspace.features)
    return NextMission(draws, draws)


def mean_of(params: Draws | xr.DataTree, workspace: Workspace) -> Draws:
    """Return the mean of a posterior, with expected effects, or of draws."""
    return draws_of(params, workspace).expected.mean()


def mean_and_draws_of(
    params: Draws | xr.DataTree, workspace: Workspace
) -> tuple[Draws, Draws | None]:
    """Return `mean_of` and the draws for bands, or None if there is only a single draw."""
    expected, drawn = draws_of(params, workspace)
    return expected.mean(), drawn if drawn.n_draws > 1 else None
