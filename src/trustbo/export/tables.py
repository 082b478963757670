"""What missions measured and what was learned of them, as one table for pandas or R."""

from os import PathLike

import numpy as np
import pandas as pd

from trustbo.export.checks import require_file
from trustbo.files import write_text
from trustbo.result import Result
from trustbo.simulation.rows import column_of

_TRUST = ("trust_mean", "trust_sd")


def write_csv(path: str | PathLike[str], result: Result) -> None:
    """Write a table with one row per mission (from 0), bound that was run (from 1), and robot.

    Columns are `mission`, `bound`, `robot`, `row` and `col` of the cell entered, `contact_rate`,
    `duration` (s), `exposure` (ticks), `status` of the bound, `mission_status`, a column for each
    awareness feature as in `simulation.write_table`, and `trust_mean` and `trust_sd`, latent trust
    under the last posterior. A blank is "not measured", or a mission that it is not of.

    Args:
        path: The file; a complete one replaces it, or nothing.
        result: What a campaign learned.

    Raises:
        TrustboError: The path is no file to be.
    """
    target = require_file(path)
    latent = result.posterior["latent"].to_dataset()
    trust = {name: latent[name].values for name in _TRUST}
    # With update="moment_matched" a posterior is of its last mission alone.
    first = len(result.missions) - latent.sizes["mission"]
    rows = []
    for j, mission in enumerate(result.missions):
        for k, bound in enumerate(mission.bounds):
            for i, robot in enumerate(mission.robots):
                row, col = bound.cell
                rows.append(
                    {
                        "mission": j,
                        "bound": k + 1,
                        "robot": robot,
                        "row": row,
                        "col": col,
                        "contact_rate": bound.contact_rate[i],
                        "duration": bound.duration[i],
                        "exposure": bound.exposure[i],
                        "status": bound.status,
                        "mission_status": mission.status,
                    }
                    | dict(zip(map(_column, mission.features), bound.awareness[i], strict=True))
                    | {n: a[j - first, k, i] if j >= first else np.nan for n, a in trust.items()}
                )
    write_text(target, pd.DataFrame(rows).to_csv(index=False, lineterminator="\n"))


def _column(feature: str) -> str:
    """As in `simulation.write_table`, and apart from the columns of latent trust."""
    return f"awareness_{feature}" if feature in _TRUST else column_of(feature)
