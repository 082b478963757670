"""Settings and data of the paper: Zheng, Smereka, Mikulski and Wang 2021, arXiv 2201.01878.

    >>> workspace = tb.Workspace.from_terrain(terrain, **tb.paper.WORKSPACE)
    >>> result = tb.iterate(workspace, start, goal, **tb.paper.CAMPAIGN)

The model, the objective, the policy, the first path and the sampler follow the paper. The list
below contains all known differences; the documentation gives the reasons.

Model:

- Priors: the paper does not state them. Here they are `Priors.for_cells()`, and trust before the
  first bound is N(0.5, 0.5^2).
- Latent trust is integrated out, which leaves the posterior unchanged.
- The memory beta0 is in (0, 1); in the paper, it is any real number.
- The variance of a contact rate includes the resolution of the rate in addition to delta_v^2.

Data:

- Measured awareness, simulated by `simulation.RealtimeAwareness`, is used for learning. The
  awareness of the map is used for planning and where nothing was measured.
- Each feature is a principal component as in the paper, but of clipped pixel features, and its sign
  is declared instead of being left to the solver.
- While T2 closes up, contact is that of the lead's lidar, and counts in the rates of the robots.
- The lead stops near the centre of the next cell, where the surrounding routes are seen best.
- Campaigns learn from all missions at once. In the paper, the posterior of one iteration is the
  prior of the next one. The paper also learns on a given terrain first, and starts on the mission
  terrain with the resulting posterior. To do this, pass the result on the given terrain as
  `earlier=`.

Planning:

- Trust x in the cost (6) is the mean over the robots; in the paper, it is trust in one robot r_i.
- Paths have at most two bounds more than the shortest path, and no U-turns. The paper allows all
  paths.
- Bounds that failed twice are avoided. In the paper, a failure only ends the mission.
"""

from collections.abc import Mapping
from typing import Any

from trustbo.models import PooledTrust, Priors
from trustbo.terrain import PAPER_VISIBILITY, TRAVERSABILITY

__all__ = ["CAMPAIGN", "MEAN_TRUST", "WORKSPACE"]

WORKSPACE: Mapping[str, Any] = {
    "features": {"traversability": TRAVERSABILITY, "visibility": PAPER_VISIBILITY},
    "bounds": False,
}
"""Keywords of `Workspace.from_terrain`. The awareness z in (1) and (3) describes the cell entered.
Its two features are composites, each the first principal component of several pixel features."""

CAMPAIGN: Mapping[str, Any] = {
    "model": PooledTrust(Priors.for_cells()),
    "policy": "greedy",
    "objective": "terminal",
    "initial": "prior_draw",
    "sampler": "nuts",
    "awareness": "measured",
}
"""Keywords of `iterate` and `Campaign`. The model consists of equations (3) and (4), with one set
of parameters for all robots and no effects; NUTS samples its posterior (5). Each path minimises the
cost (6), 1 - sigma(trust at the goal), under the posterior mean. The first path minimises the cost
under one draw of the prior. Learning uses measured awareness where there is any."""

MEAN_TRUST: Mapping[str, Any] = {**CAMPAIGN, "objective": "mean"}
"""Keywords like `CAMPAIGN`, but each path maximises the mean trust over its bounds. The paper also
describes the best path as the one with the maximum expected trust. The cost (6) hardly depends on
the path: all paths have the same goal, and trust forgets earlier bounds."""
