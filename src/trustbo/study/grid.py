"""Grids of campaigns (cases x scenes x seeds) that run in parallel and can be resumed."""

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
from trustbo.errors import (
    TrustboError,
    composed,
    require_count,
    require_kind,
    require_list,
    require_whole,
)
from trustbo.files import FilePath, to_path, write_file
from trustbo.simulation import Truth
from trustbo.simulation.protocol import Simulator
from trustbo.workspace import Workspace

_MAX_JOBS = 10**6
"""Largest number of processes that joblib may leave free (a negative `n_jobs`)."""
_N_SHOWN = 3
"""Number of runs whose errors the message contains."""


class Scene(NamedTuple):
    """World of a simulated campaign: the assumed workspace, the simulator, start and goal.

    Example:
        >>> def make_scene():
        ...     simulator = tb.simulation.RadioSimulator(workspace)
        ...     truth = tb.simulation.Truth.from_simulator(simulator)
        ...     return tb.study.Scene(workspace, simulator, (9, 0), (0, 9), truth=truth)
    """

    workspace: Workspace
    simulator: Simulator
    start: Cell
    goal: Cell
    truth: Truth | None = None
    """Truth of the simulator, used to compute the regret and loss of paths."""
    options: Mapping[str, Any] = {}
    """Options of `Campaign` in this scene, which the options of a case override."""
    labels: Mapping[str, Any] = {}
    """Additional columns of the table that `run_grid` returns, and their values."""
    judged: Mapping[str, Any] = {}
    """Options of `Truth.best` for the best path, such as `max_bounds`."""


type Case = Mapping[str, Any] | Callable[[Scene], Mapping[str, Any]]
"""Options of `Campaign`, or a function that returns the options for a scene."""


def run_grid(
    cases: Mapping[str, Case],
    scenes: Mapping[str, Callable[[], Scene]],
    folder: FilePath,
    *,
    seeds: Sequence[int] = (0,),
    n_missions: int = 15,
    n_jobs: int = -1,
) -> pd.DataFrame:
    """Run a campaign for each case, scene and seed, and evaluate the paths of all missions.

    Each run writes a file whose name contains the case, scene, seed and number of missions. A run
    is skipped if its file exists. Runs are parallelised with joblib; `joblib.parallel_config`
    selects another backend, such as `backend="dask"` for a cluster. If the policy has a method
    `learn(campaign, mission)`, it is called after each mission. If the policy has a method
    `recommend(campaign)`, its path replaces the campaign's recommendation.

    Args:
        cases: Cases, keyed by name.
        scenes: Functions, keyed by name, that make the scenes in the worker processes.
        folder: Folder for the files of the runs, one CSV file per run.
        seeds: Seeds of the campaigns.
        n_missions: Number of missions per campaign.
        n_jobs: Number of processes; -1 for one per core, 1 to use only this process.

    Returns:
        One row per run and mission, with `case`, `scene`, `seed`, the labels of the scene, and
        `mission`, which is 0 before the first mission. `regret` (%) and `lost` (bounds) describe
        the path recommended after the mission, and `best` is the loss on the best path, all in the
        world of the next mission (see `Truth`). `status` and mean `contact_rate` describe the
        mission itself. `driven` and `best_driven` are the expected losses on the driven path and on
        the best path. `failed_driven` is the difference of these losses if bounds that fail or are
        not reached count as fully lost. `seconds` is the CPU time of planning, simulating and
        learning, without the evaluation of the paths.

    Raises:
        TrustboError: A run failed; call the function again to repeat failed runs.

    Example:
        >>> cases = {"default": {}, "thompson": {"policy": "thompson"}}
        >>> scenes = {"hills": make_scene}
        >>> table = tb.study.run_grid(cases, scenes, "out", n_missions=2, n_jobs=1)
    """
    require_count("n_missions", n_missions)
    require_kind("cases", cases, Mapping, "give a dict of cases by name")
    require_kind("scenes", scenes, Mapping, "give a dict of functions that make scenes, by name")
    for name in (*cases, *scenes):
        require_kind("the name of a case or scene", name, str, "give a text")
    seeds = [require_whole("seed", seed, 0) for seed in require_list("seeds", seeds)]
    if require_whole("n_jobs", n_jobs, -_MAX_JOBS) == 0:
        raise TrustboError("n_jobs must be a number of processes, or -1; got 0.")
    if not (cases and scenes and seeds):
        raise TrustboError("run_grid needs at least one case, one scene and one seed.")

    root = to_path(folder)
    runs = list(product(seeds, scenes, cases))
    files = {
        (seed, scene, case): root / f"{_plain(case)}~{_plain(scene)}~{seed}~{n_missions}.csv"
        for seed, scene, case in runs
    }

    # Some file systems ignore the case of letters.
    if len({str(file).casefold() for file in files.values()}) < len(runs):
        raise TrustboError(
            "names of cases, and of scenes, must differ in more than punctuation and the case of "
            "letters; rename one."
        )

    errors = Parallel(n_jobs=n_jobs)(
        delayed(_run)(cases[case], scenes[scene], (case, scene, seed), n_missions, file)
        for (seed, scene, case), file in files.items()
        if not file.exists()
    )

    failed = [error for error in errors if error]
    if failed:
        raise TrustboError(
            f"{len(failed)} of {len(runs)} runs failed; call run_grid again to repeat them. The "
            f"first errors are: {'; '.join(failed[:_N_SHOWN])}"
        )
    return pd.concat([_read(file, *run) for run, file in files.items()], ignore_index=True)


def _plain(name: str) -> str:
    return re.sub(r"\W+", "-", composed(name))


def _read(file: Path, seed: int, scene: str, case: str) -> pd.DataFrame:
    """Read the rows of a run; texts such as "NA" are kept, and names may look like numbers."""
    table = pd.read_csv(file, keep_default_na=False, na_values=[""])
    return table.assign(case=case, scene=scene, seed=seed)


def _run(
    case: Case, scene: Callable[[], Scene], names: tuple[str, str, int], n_missions: int, file: Path
) -> str:
    """Run a campaign and write its rows to a file; return the error message, or ""."""
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
    except Exception as error:  # an error in one run does not stop the others
        return f"{', '.join(map(str, names))}: {type(error).__name__}: {error}"
    return ""


def _rows(case: Case, scene: Scene, seed: int, n_missions: int) -> Iterator[dict[str, Any]]:
    """Run a campaign and yield its rows; the first is from before the first mission."""
    options = case(scene) if callable(case) else case
    given = {
        "workspace": scene.workspace,
        "start": scene.start,
        "goal": scene.goal,
        "seed": seed,
        **scene.options,
        **copy.deepcopy(dict(options)),  # a policy with a state must not be shared by runs
    }

    with Campaign(**given) as campaign:
        policy = campaign.policy
        yield {"mission": 0, **_recommended(_path_of(campaign), scene, 0)}

        began = time.process_time()
        driven = campaign.run(scene.simulator, n_missions)

        for number, (_, mission) in enumerate(driven, start=1):
            if hasattr(policy, "learn"):
                policy.learn(campaign, mission)  # pyright: ignore[reportFunctionMemberAccess]
            path = _path_of(campaign)
            seconds = time.process_time() - began

            row = {"mission": number, **_recommended(path, scene, number)}
            contact_rate = campaign.state.entries[-1].row["contact_rate"]
            row |= {"status": mission.status, "contact_rate": contact_rate}
            row |= _driven(mission.path, scene, number - 1)
            yield row | {"seconds": seconds}
            began = time.process_time()


def _path_of(campaign: Campaign) -> Sequence[Cell]:
    """Return the path that a campaign, or its policy, recommends."""
    choose = getattr(campaign.policy, "recommend", None)
    return campaign.recommend().path if choose is None else choose(campaign)


def _recommended(path: Sequence[Cell], scene: Scene, mission: int) -> dict[str, float]:
    """Compute regret and loss of the path recommended before `mission`, an index from 0."""
    if scene.truth is None:
        return {}

    truth = scene.truth.at(mission)
    best = truth.best(scene.start, scene.goal, **scene.judged)
    regret = truth.regret(path, **scene.judged)
    return {"regret": regret, "lost": truth.lost(path), "best": truth.lost(best)}


def _driven(path: Sequence[Cell], scene: Scene, mission: int) -> dict[str, float]:
    """Compute the expected losses on the path of `mission`, an index from 0, and on the best."""
    if scene.truth is None:
        return {}

    truth = scene.truth.at(mission)
    ends = (scene.start, scene.goal)
    best = truth.best(*ends, **scene.judged)
    safest = truth.best(*ends, **scene.judged, failures=True)
    return {
        "driven": truth.lost(path),
        "best_driven": truth.lost(best),
        "failed_driven": truth.lost_or_failed(path) - truth.lost_or_failed(safest),
    }
