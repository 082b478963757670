"""Table of measurements and of learned trust, for pandas or R."""

import numpy as np

from trustbo.campaign.result import Result
from trustbo.errors import require_kind
from trustbo.files import FilePath, require_file, write_text
from trustbo.logs.table import to_frame


def write_csv(path: FilePath, result: Result) -> None:
    """Write a table with a row for each mission, bound and robot, numbered from 1.

    Columns are those of `logs.to_frame`, and `trust_mean` and `trust_sd`, latent trust under the
    last posterior; blank for a value that was not measured, for the start cell, and for the trust
    of a mission that the last posterior does not cover.

    Args:
        path: File to write, or to replace.
        result: Result of a campaign.

    Raises:
        TrustboError: The file cannot be written.
    """
    target = require_file(path)
    require_kind("result", result, Result, "give a Result, as iterate returns it")
    table, latent = to_frame(result.missions), result.posterior["latent"].to_dataset()
    # A posterior need not cover all missions: some are excluded, or wait to be learned from.
    of_mission = {int(j) + 1: i for i, j in enumerate(latent["mission"].values)}
    keys = table[["mission", "bound", "robot"]].itertuples(index=False, name=None)
    robots = result.workspace.team.names
    at = [(of_mission.get(j, -1), k - 1, robots.index(robot)) for j, k, robot in keys]
    for name in ("trust_mean", "trust_sd"):
        values, n_bounds = latent[name].values, latent.sizes["bound"]
        table[name] = [
            values[i, k, r] if i >= 0 and 0 <= k < n_bounds else np.nan for i, k, r in at
        ]
    write_text(target, table.to_csv(index=False, lineterminator="\n"))
