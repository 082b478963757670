"""Readers of three studies of trust that people report, whose files the user has."""

from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.logs.reports import outcome_of, person_mission, read_reports, report_in
from trustbo.logs.rows import needed_columns, number_of

_STUDY = ": is it the study's?"


def read_azevedo_sa(file: str | PathLike[str]) -> list[Mission]:
    """Read the study of Azevedo-Sa et al. (2021): trust in a driving task after three others.

    A seen task's demand is the share of its needs, sensing and processing, that are no less than
    those of the asked task; the mean need of the asked task is the input `need`. Levels are 1 to 7.

    Args:
        file: Table with the columns person, step, success, sensing, processing, asked_sensing,
            asked_processing and trust, the logistic function of the rating less 4.

    Raises:
        TrustboError: See `read_reports`.
    """
    needs = ("sensing", "processing", "asked_sensing", "asked_processing", "trust")
    columns = needed_columns(file, ("person", "step", "success", *needs), remedy=_STUDY)
    number = {
        name: np.array(
            [number_of(f"row {i + 1}", name, text) for i, text in enumerate(columns[name])]
        )
        for name in needs
    }
    share = np.clip(number["trust"], 0.01, 0.99)
    rating = np.clip(np.round(np.log(share / (1.0 - share)) + 4.0), 1, 7)
    pairs = [(number[n], number[f"asked_{n}"]) for n in ("sensing", "processing")]
    table = {name: columns[name] for name in ("person", "step", "success")}
    table["report"] = rating.tolist()
    table["demand"] = np.mean([seen >= asked for seen, asked in pairs], axis=0).tolist()
    table["need"] = np.mean([asked for _, asked in pairs], axis=0).tolist()
    return read_reports(
        table, outcome="success", demand="demand", inputs=("need",), scale="likert7"
    )


def read_soh(file: str | PathLike[str]) -> list[Mission]:
    """Read a study of Soh et al. (2018): trust in tasks before and after two others were seen.

    Bound 1 is before, and has reports of five tasks, A and B being those that are seen then; bound
    2 is after, and has reports of C, D and E. Features are the task, `task_1` to `task_12`, the
    outcome, and for tasks of the category of the seen ones (1 to 6, 7 to 12) `success_same` and
    `failure_same` as well.

    Args:
        file: Table with a row for each person: person (optional), `A_ID` to `E_ID`, `A_rating`,
            `B_rating`, `C1_rating` to `E1_rating`, `C2_rating` to `E2_rating` from 1 to 7, and
            `B_SF`, 1 where the seen tasks succeeded.

    Raises:
        TrustboError: See `read_reports`.
    """
    before = {t: f"{t}_rating" if t in "AB" else f"{t}1_rating" for t in "ABCDE"}
    names = (*(f"{t}_ID" for t in "ABCDE"), *before.values(), "B_SF")
    names += ("C2_rating", "D2_rating", "E2_rating")
    columns = needed_columns(file, names, remedy=_STUDY)
    features = (*(f"task_{n}" for n in range(1, 13)), "success", "failure", "success_same",
                "failure_same")  # fmt: skip
    missions = []
    for i in range(len(columns["B_SF"])):
        where = f"row {i + 1}"
        tasks = [number_of(where, f"{t}_ID", columns[f"{t}_ID"][i]) for t in "ABCDE"]
        if not all(task in range(1, 13) for task in tasks):
            raise TrustboError(f"{where}: tasks must be 1 to 12; got {tasks}.")
        succeeded = outcome_of(where, "B_SF", columns["B_SF"][i])
        z, y = np.zeros((2, 5, len(features))), np.full((2, 5), np.nan)
        for r, t in enumerate("ABCDE"):
            z[:, r, int(tasks[r]) - 1] = 1.0
            y[0, r] = report_in(where, before[t], columns[before[t]][i], 7)
            if t in "CDE":
                y[1, r] = report_in(where, f"{t}2_rating", columns[f"{t}2_rating"][i], 7)
            same = float((tasks[r] > 6) == (tasks[0] > 6))
            z[1, r, 12:14] = succeeded
            z[1, r, 14:] = same * np.array(succeeded)
        missions.append(person_mission(z, y, features, tuple("ABCDE"), "likert7"))
    return missions


def read_du(file: str | PathLike[str], *, events: bool = False) -> list[Mission]:
    """Read a study of Du et al. (2025): trust before and after each of ten steps.

    Changes of trust in these files are almost a function of level and event: they test inputs, and
    are no evidence on people.

    Args:
        file: Table with the columns person, step, trust_before, trust_after, state and task_result.
        events: Whether outcomes are apart by the level of trust before (from .5, or below) and the
            state, instead of two inputs.

    Raises:
        TrustboError: See `read_reports`.
    """
    names = ("person", "step", "trust_before", "trust_after", "state", "task_result")
    columns = needed_columns(file, names, remedy=_STUDY)
    table: dict[str, list[Any]] = {name: [] for name in ("person", "step", "report", "outcome")}
    kinds = [
        f"{o}_{h}_{s}" for o in ("success", "failure") for h in ("high", "low") for s in (0, 1)
    ]
    table |= {name: [] for name in kinds}
    for i, who in enumerate(columns["person"]):
        where = f"row {i + 1}"
        values = {
            name: number_of(where, name, columns[name][i])
            for name in ("step", "trust_before", "trust_after", "state", "task_result")
        }
        result = values["task_result"] > 0.0
        level = "high" if values["trust_before"] >= 0.5 else "low"
        kind = f"{'success' if result else 'failure'}_{level}_{int(values['state'])}"
        if who not in table["person"]:
            _append(table, who, 0, values["trust_before"], "", dict.fromkeys(kinds, 0.0))
        of_kind = {name: float(name == kind) for name in kinds}
        _append(table, who, values["step"], values["trust_after"], str(int(result)), of_kind)
    if events:
        table.pop("outcome")
        return read_reports(table, inputs=kinds)
    return read_reports(table, outcome="outcome")


def _append(
    table: dict[str, list[Any]], who: str, step: float, trust: float, outcome: str,
    kinds: Mapping[str, float],
) -> None:  # fmt: skip
    values = {"person": who, "step": step, "report": trust, "outcome": outcome, **kinds}
    for name, value in values.items():
        table[name].append(value)
