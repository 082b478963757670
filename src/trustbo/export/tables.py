"""Table of measurements and of learned trust, for pandas or R."""

import numpy as np
import pandas as pd

from trustbo.campaign.result import Result
from trustbo.errors import require_kind
from trustbo.files import FilePath, require_file, write_text
from trustbo.logs.rows import KEYS, column_of
from trustbo.spreadsheet import frame_as_csv

_TRUST = ("trust_mean", "trust_sd")


def write_csv(path: FilePath, result: Result) -> None:
    """Write a table with a row for each mission, bound run (both from 1) and robot.

    Columns are `mission`, `bound`, `robot`, `row` and `col` of the cell entered, `contact_rate`,
    `duration` (s), `n_ticks`, `status` of the bound, `mission_status`, a column for each awareness
    feature as in `logs.to_frame`, and `trust_mean` and `trust_sd`, latent trust under the last
    posterior. A blank stands for a value that was not measured, or for the trust of a mission that
    the last posterior does not cover.

    Args:
        path: File to write, or to replace.
        result: Result of a campaign.

    Raises:
        TrustboError: The file cannot be written.
    """
    target = require_file(path)
    require_kind("result", result, Result, "give a Result, as iterate returns it")
    latent = result.posterior["latent"].to_dataset()
    # A posterior need not cover all missions: some are excluded, or wait to be learned from.
    numbers = [int(j) for j in latent["mission"].values]
    trust = {name: dict(zip(numbers, latent[name].values, strict=True)) for name in _TRUST}
    rows = []
    for j, mission in enumerate(result.missions):
        for k, bound in enumerate(mission.bounds):
            for i, robot in enumerate(mission.robots):
                rates = {n: getattr(bound, n)[i] for n in ("contact_rate", "duration", "n_ticks")}
                rows.append(
                    dict(zip(KEYS, (j + 1, k + 1, robot, *bound.cell), strict=True))
                    | rates
                    | {"status": bound.status, "mission_status": mission.status}
                    | dict(zip(map(_column, mission.features), bound.awareness[i], strict=True))
                    | {n: a[j][k, i] if j in a else np.nan for n, a in trust.items()}
                )
    write_text(target, frame_as_csv(pd.DataFrame(rows), index=False))


def _column(feature: str) -> str:
    """Return the column of a feature, renamed if it is one of latent trust."""
    return f"awareness_{feature}" if feature in _TRUST else column_of(feature)
