"""Alarms of a campaign: large changes of the world that are more probable than not."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.campaign.masking import mission_numbers
from trustbo.data import Mission
from trustbo.inference.changes import scan_posterior
from trustbo.models.effects.change import Change
from trustbo.models.model import TrustModel
from trustbo.workspace import Workspace

_COLUMNS = (
    "change", "kind", "where", "from_mission", "earliest", "effect", "sd", "probability", "ties",
)  # fmt: skip
_PROBABLE = 0.5


def alarms_of(
    posterior: xr.DataTree,
    missions: Sequence[Mission],
    workspace: Workspace,
    model: TrustModel | None = None,
) -> pd.DataFrame:
    """Tabulate the changes that are together more probable than not, the most probable first.

    Changes of less than a tenth of contact are none.

    Args:
        posterior: Posterior of a campaign, with the numbers of its missions.
        missions: All missions of the campaign.
        workspace: Workspace of the campaign.
        model: Model of the campaign, where it has custom priors.

    Raises:
        TrustboError: Changes cannot be weighed under the model, see `inference.changes`.
    """
    numbers = np.array(mission_numbers(posterior))
    learned = [missions[j] for j in numbers]
    weighed = scan_posterior(posterior, learned, workspace, model=model)
    candidates, names, rows = weighed.candidates, workspace.team.names, []
    p = np.where(weighed.large, weighed.p, 0.0)
    order = np.argsort(-p, kind="stable")
    before = np.cumsum(p[order]) - p[order]
    for i in order[before <= _PROBABLE] if p.sum() > _PROBABLE else ():
        change, start = candidates.change(i), candidates.earliest[candidates.first[i]]
        where = names[change.where[0]] if change.kind == "robot" else change.where
        ties = "; ".join(_text(tie, names, numbers) for tie in candidates.ties(i))
        first = numbers[[change.from_mission, start]] + 1
        size = float(weighed.effect[i]), float(weighed.sd[i]), float(weighed.p[i])
        rows.append(
            (_text(change, names, numbers), change.kind, where, *first.tolist(), *size, ties)
        )
    return pd.DataFrame(rows, columns=list(_COLUMNS))


def sentences_of(alarms: pd.DataFrame) -> list[str]:
    """Describe each alarm in a sentence, with the changes that the paths do not separate from it.

    Args:
        alarms: Table of `alarms_of`.
    """
    sentences = []
    for alarm in alarms.to_dict("records"):
        verb = "less" if alarm["effect"] < 0 else "more"
        text = f"{alarm['change']}: {verb} contact, by {abs(alarm['effect']):.2f}"
        ties = f"; or, equal on these paths, {alarm['ties']}" if alarm["ties"] else ""
        sentences.append(f"{text} (P {alarm['probability']:.2f}){ties}.")
    return sentences


def _text(change: Change, names: Sequence[str], numbers: np.ndarray) -> str:
    what = {
        "all": lambda: "all robots",
        "robot": lambda robot: names[robot],
        "area": lambda row, col, radius: f"area within {radius} of ({row}, {col})",
    }[change.kind](*change.where)
    return f"{what} from mission {numbers[change.from_mission] + 1} on"
