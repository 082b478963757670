"""The paper as printed: Zheng, Smereka, Mikulski and Wang 2021, arXiv 2201.01878.

    >>> workspace = tb.Workspace.from_terrain(terrain, **tb.paper.WORKSPACE)
    >>> result = tb.iterate(workspace, start, goal, **tb.paper.CAMPAIGN)

The model, the objective, the policy, the first path and the sampler are those of the paper. Two
things differ: the prior of trust before the first bound, which the paper does not specify, and
latent trust is integrated out, which leaves the posterior unchanged.
"""

from collections.abc import Mapping
from typing import Any

from trustbo.models import PooledTrust
from trustbo.terrain import PAPER_VISIBILITY, TRAVERSABILITY

__all__ = ["CAMPAIGN", "WORKSPACE"]

WORKSPACE: Mapping[str, Any] = {
    "features": {"traversability": TRAVERSABILITY, "visibility": PAPER_VISIBILITY},
    "bounds": False,
}
"""Keywords of `Workspace.from_terrain`: awareness z of (1) and (3) describes the cell entered. Its
features are two composites, each the first principal component of features of pixels."""

CAMPAIGN: Mapping[str, Any] = {
    "model": PooledTrust(),
    "policy": "greedy",
    "objective": "terminal",
    "initial": "prior_draw",
    "sampler": "nuts",
}
"""Keywords of `iterate` and `Campaign`. The model is equations (3) and (4), one set of parameters
for all robots, without effects; NUTS samples its posterior (5). A path is the best under the
posterior mean, by trust at the goal: the cost (6) is 1 - sigma(trust). The first path is the best
under one draw of the prior."""
