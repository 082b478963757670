"""Settings and data of the paper: Zheng, Smereka, Mikulski and Wang 2021, arXiv 2201.01878.

    >>> workspace = tb.Workspace.from_terrain(terrain, **tb.paper.WORKSPACE)
    >>> result = tb.iterate(workspace, start, goal, **tb.paper.CAMPAIGN)

The model, the objective, the policy, the first path and the sampler follow the paper. There are two
differences: trustbo chooses the prior of trust before the first bound, which the paper does not
specify, and integrates latent trust out, which leaves the posterior unchanged.
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
"""Keywords of `Workspace.from_terrain`. The awareness z in (1) and (3) describes the cell entered.
Its two features are composites, each the first principal component of several pixel features."""

CAMPAIGN: Mapping[str, Any] = {
    "model": PooledTrust(),
    "policy": "greedy",
    "objective": "terminal",
    "initial": "prior_draw",
    "sampler": "nuts",
}
"""Keywords of `iterate` and `Campaign`. The model consists of equations (3) and (4), with one set
of parameters for all robots and no effects; NUTS samples its posterior (5). Each path minimises the
cost (6), 1 - sigma(trust at the goal), under the posterior mean. The first path minimises the cost
under one draw of the prior."""
