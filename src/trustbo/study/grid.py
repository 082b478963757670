"""Grids of campaigns (cases x scenes x seeds), run in parallel processes and resumable."""

import copy
import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from trustbo.campaign.campaign import Campaign
from trustbo.data import Cell
from trustbo.errors import TrustboError, require_whole
from trustbo.files import FilePath, write_file
from trustbo.simulation import Truth
from trustbo.simulation.protocol import Simulator
from trustbo.workspace import Workspace


class Scene(NamedTuple):
    """Setting of a campaign: the assumed workspace, the true world, and a start and goal."""

    workspace: Workspace
    simulator: Simulator
    start: Cell
    goal: Cell
    truth: Truth | None = None
    """Truth of the simulator, used to evaluate paths."""
    options: Mapping[str, Any] = {}
    """Options of `Campaign` in this scene; options of a case override them."""
    labels: Mapping[str, Any] = {}
    """Further columns of the table."""
    judged: Mapping[str, Any] = {}
    """Options of `Truth.best`, such as `max_bounds`, for the reference path."""


type Case = Mapping[str, Any] | Callable[[Scene], Mapping[str, Any]]
"""Options of `Campaign`, or a function that makes them for a scene."""


def run_grid(
    cases: Mapping[str, Case],
    scenes: Mapping[str, Callable[[], Scene]],
    folder: FilePath,
    *,
    seeds: Sequence[int] = (0,),
    n_missions: int = 15,
    n_jobs: int = -1,
) -> pd.DataFrame:
    """Run each case on each scene with each seed, and evaluate the paths of each mission.

    Each run writes a file named by its case, scene, seed and number of missions; runs whose files
    exist are skipped. Runs are parallelised by joblib; `joblib.parallel_config` selects another
    backend, such as `backend="dask"` for a cluster. A policy's method `learn(campaign, mission)`,
    if any, is called after each mission; the path of its `recommend(campaign)`, if any, replaces
    the campaign's recommendation.

    Args:
        cases: Cases by name.
        scenes: Functions that make the scenes, by name; they are called in the worker processes.
        folder: Folder of the runs.
        seeds: Seeds of the campaigns.
        n_missions: Missions of a campaign.
        n_jobs: Number of processes; -1 for one per core, 1 to use only this process.

    Returns:
        One row per run and mission: `case`, `scene`, `seed`, labels of the scene, and `mission`,
        with 0 before the first one. `regret` (%) and `lost` (bounds) describe the path recommended
        after the mission, evaluated in the world of the next one, see `Truth`; `best` is the loss
        of the best path there. The mission itself has `status`, mean `contact_rate`, `driven` and
        `best_driven`, the expected losses on its path and on the best path, `failed_driven`, the
        additional loss if bounds that fail or are not reached keep no contact, and `seconds` of
        processor time.

    Raises:
        TrustboError: Some runs failed; the next call repeats them.

    Example:
        >>> cases = {"greedy": {}, "thompson": {"policy": "thompson"}}
        >>> table = tb.study.run_grid(cases, {"hills": make_scene}, "out", seeds=range(3))
    """
    require_whole("n_missions", n_missions, 1)
    kept, runs = Path(folder), list(product(seeds, scenes, cases))
    files = {
        (seed, scene, case): kept / f"{_plain(case)}~{_plain(scene)}~{seed}~{n_missions}.csv"
        for seed, scene, case in runs
    }
    if len(set(files.values())) < len(runs):
        raise TrustboError("names of cases and scenes must differ in their letters and digits.")
    errors = Parallel(n_jobs=n_jobs)(
        delayed(_run)(cases[case], scenes[scene], (case, scene, seed), n_missions, file)
        for (seed, scene, case), file in files.items()
        if not file.exists()
    )
    if failed := [error for error in errors if error]:
        raise TrustboError(
            f"{len(failed)} of {len(runs)} runs failed; the next call repeats them: "
            f"{'; '.join(failed[:3])}"
        )
    return pd.concat([pd.read_csv(file) for file in files.values()], ignore_index=True)


def _plain(name: str) -> str:
    return re.sub(r"\W+", "-", name)


def _run(
    case: Case, scene: Callable[[], Scene], names: tuple[str, str, int], n_missions: int, file: Path
) -> str:
    """Run a campaign and write its rows to a file; return the error, if any."""
    labels = dict(zip(("case", "scene", "seed"), names, strict=True))
    try:
        with warnings.catch_warnings(), threadpool_limits(1):
            warnings.simplefilter("ignore")
            where = scene()
            rows = [
                labels | dict(where.labels) | row
                for row in _rows(case, where, names[2], n_missions)
            ]
        write_file(file, lambda path: pd.DataFrame(rows).to_csv(path, index=False))
    except Exception as error:  # of one run, which does not stop the others
        return f"{', '.join(map(str, names))}: {type(error).__name__}: {error}"
    return ""


def _rows(case: Case, scene: Scene, seed: int, n_missions: int) -> Iterator[dict[str, Any]]:
    """Run a campaign and return its rows; the first row is before any mission."""
    options = case(scene) if callable(case) else case
    given = {
        "workspace": scene.workspace, "start": scene.start, "goal": scene.goal, "seed": seed,
        **scene.options, **copy.deepcopy(dict(options)),
    }  # fmt: skip
    with Campaign(**given) as campaign:
        policy = campaign.policy
        yield {"mission": 0, **_recommended(campaign, scene, 0)}
        began = time.process_time()
        driven = campaign.run(scene.simulator, n_missions)
        for number, (_, mission) in enumerate(driven, start=1):
            if hasattr(policy, "learn"):
                policy.learn(campaign, mission)  # pyright: ignore[reportFunctionMemberAccess]
            row = {"mission": number, **_recommended(campaign, scene, number)}
            row |= {"status": mission.status, "contact_rate": mission.contact_rate.mean()}
            row |= _driven(mission.path, scene, number - 1)
            yield row | {"seconds": time.process_time() - began}
            began = time.process_time()


def _recommended(campaign: Campaign, scene: Scene, mission: int) -> dict[str, float]:
    """Compute regret and loss of the path recommended for a mission."""
    if scene.truth is None:
        return {}
    choose = getattr(campaign.policy, "recommend", None)
    path = campaign.recommend().path if choose is None else choose(campaign)
    truth = scene.truth.at(mission)
    best = truth.best(scene.start, scene.goal, **scene.judged)
    regret = truth.regret(path, **scene.judged)
    return {"regret": regret, "lost": truth.lost(path), "best": truth.lost(best)}


def _driven(path: Sequence[Cell], scene: Scene, mission: int) -> dict[str, float]:
    """Compute the expected loss on the path of a mission, and on the best path."""
    if scene.truth is None:
        return {}
    truth, ends = scene.truth.at(mission), (scene.start, scene.goal)
    best = truth.best(*ends, **scene.judged)
    safest = truth.best(*ends, **scene.judged, failures=True)
    return {
        "driven": truth.lost(path),
        "best_driven": truth.lost(best),
        "failed_driven": truth.lost_or_failed(path) - truth.lost_or_failed(safest),
    }
