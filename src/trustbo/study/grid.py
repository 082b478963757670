"""Grids of campaigns (cases x scenes x seeds) that run in parallel and can be resumed."""

import copy
import numbers
import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from pickle import PicklingError
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from joblib.externals.loky import get_reusable_executor
from threadpoolctl import threadpool_limits

from trustbo.campaign.campaign import Campaign
from trustbo.campaign.result import Result
from trustbo.data import Cell, Mission
from trustbo.errors import (
    TrustboError,
    composed,
    one_line,
    require_count,
    require_kind,
    require_list,
    require_whole,
)
from trustbo.files import FilePath, interpreting, to_path, write_text
from trustbo.identity import fingerprint
from trustbo.models.backend import VERSIONS
from trustbo.simulation import Truth
from trustbo.simulation.protocol import Simulator
from trustbo.workspace import Workspace

_N_SHOWN = 3
"""Number of runs whose errors the message contains."""
_PARTS = {Result: lambda result: result.missions}
"""What identifies an earlier campaign in a case: its missions."""


class Scene(NamedTuple):
    """World of a simulated campaign: the assumed workspace, the simulator, and its courses.

    A campaign has one course, from `start` to `goal`, or those of `courses` in turn.

    Example:
        >>> def make_scene():
        ...     simulator = tb.simulation.RadioSimulator(workspace)
        ...     truth = tb.simulation.Truth.from_simulator(simulator)
        ...     return tb.study.Scene(workspace, simulator, (9, 0), (0, 9), truth=truth)
    """

    workspace: Workspace
    simulator: Simulator
    start: Cell | None = None
    goal: Cell | None = None
    truth: Truth | None = None
    """Truth of the simulator, used to compute the regret and loss of paths."""
    options: Mapping[str, Any] = {}
    """Options of `Campaign` in this scene, which the options of a case override."""
    labels: Mapping[str, Any] = {}
    """Additional columns of the table that `run_grid` returns, and their values."""
    judged: Mapping[str, Any] = {}
    """Options of `Truth.best` for the best path, such as `max_bounds`."""
    courses: Sequence[tuple[Cell, Cell]] = ()
    """Start and goal of each mission, instead of `start` and `goal`; see `iterate`."""

    def ends(self, mission: int) -> tuple[Cell, Cell]:
        """Return start and goal of a mission, an index from 0."""
        if self.courses:
            return self.courses[mission % len(self.courses)]
        if self.start is None or self.goal is None:
            raise TrustboError("a scene needs start and goal, or courses=[(start, goal), ...].")
        return self.start, self.goal


type Case = Mapping[str, Any] | Callable[[Scene], Mapping[str, Any]]
"""Options of `Campaign`, or a function that returns the options for a scene."""


class _Run(NamedTuple):
    """A run, and its file."""

    case: str
    scene: str
    seed: int
    file: Path
    identity: dict[str, str]
    """Version of trustbo, and hashes of the case and the scene, which the file records."""


def run_grid(
    cases: Mapping[Any, Case],
    scenes: Mapping[Any, Callable[[], Scene]],
    folder: FilePath,
    *,
    seeds: Sequence[int] | int = (0,),
    n_missions: int = 15,
    n_jobs: int = -1,
) -> pd.DataFrame:
    """Run a campaign for each case, scene and seed, and evaluate the paths of all missions.

    Each run writes a CSV file whose name contains the case, scene, seed and number of missions, and
    which records the version of trustbo and hashes of the case and of the function of the scene. A
    run is skipped if its file exists; if the version or a hash differs, `run_grid` raises an error.
    Hashes cover values, the user's functions and classes, and the versions of libraries, but no
    files; use another folder if these change.

    Runs are parallelised with joblib, in new processes that see the present code and working
    directory. `joblib.parallel_config` selects another backend, such as `backend="dask"` for a
    cluster, whose workers must be restarted after a change of code. If the policy has a method
    `learn(campaign, mission)`, it is called after each mission. If the policy has a method
    `recommend(campaign)`, its path replaces the campaign's recommendation.

    Args:
        cases: Cases, keyed by name; other keys, such as numbers, become texts.
        scenes: Functions, keyed in the same way, that make the scenes in the worker processes.
        folder: Folder for the files of the runs.
        seeds: Seeds of the campaigns, without repeats; a number n for 0 to n - 1.
        n_missions: Number of missions per campaign.
        n_jobs: Number of processes; -1 for one per core, 1 to use only this process.

    Returns:
        One row per run and mission, with `case`, `scene`, `seed`, the labels of the scene, and
        `mission`, which is 0 before the first mission. `regret` (%) and `lost` (bounds) describe
        the path recommended after the mission, and `best` is the loss on the best path, all in the
        world of the next mission (see `Truth`). `status`, mean `contact_rate` and `measured`, the
        contact lost (see `lost_in`), describe the mission itself. `driven` and `best_driven` are
        the expected losses on the driven path and on the best path. `failed_driven` is the
        difference of these losses if bounds that fail or are not reached count as fully lost.
        `seconds` is the CPU time of planning, simulating and learning, without the evaluation of
        the paths. Scenes without a truth lack the columns that need it.

    Raises:
        TrustboError: A run failed (call the function again to repeat failed runs), a stored run is
            of another case, scene or version, or a case or scene cannot be sent to other processes.

    Example:
        >>> cases = {"default": {}, "thompson": {"policy": "thompson"}}
        >>> scenes = {"hills": make_scene}
        >>> table = tb.study.run_grid(cases, scenes, "out", n_missions=2, n_jobs=1)
    """
    require_count("n_missions", n_missions)
    cases = _named("cases", cases)
    scenes = _named("scenes", scenes)
    seeds = _seeds_of(seeds)
    # Here and not in a worker process, so that a hash does not depend on how its code was sent.
    of_cases, of_scenes = (
        {name: fingerprint((name, one), _PARTS) for name, one in named.items()}
        for named in (cases, scenes)
    )

    root = to_path(folder)
    runs = []
    for seed, scene, case in product(seeds, scenes, cases):
        file = root / f"{_plain(case)}~{_plain(scene)}~{seed}~{n_missions}.csv"
        identity = {
            "trustbo": VERSIONS["trustbo"],
            "hash of case": of_cases[case],
            "hash of scene": of_scenes[scene],
        }
        runs.append(_Run(case, scene, seed, file, identity))

    if not runs:
        raise TrustboError("run_grid needs at least one case, one scene and one seed.")
    # Some file systems ignore the case of letters.
    if len({str(run.file).casefold() for run in runs}) < len(runs):
        raise TrustboError(
            "seeds must differ, and names of cases, and of scenes, must differ in more than "
            "punctuation and the case of letters; rename one."
        )

    for run in runs:
        if run.file.exists():
            _read(run)  # refused before other runs begin
    if n_jobs != 1:
        # joblib keeps its workers, which would go on with old code in an old folder.
        get_reusable_executor().shutdown(wait=True)
    try:
        errors = Parallel(n_jobs=n_jobs)(
            delayed(_try)(cases[run.case], scenes[run.scene], run, n_missions)
            for run in runs
            if not run.file.exists()
        )
    except PicklingError as error:
        raise TrustboError(
            "a case or scene contains a value that cannot be sent to other processes; make it in "
            "the function of the scene, or use n_jobs=1."
        ) from error

    failed = [error for error in errors if error]
    if failed:
        raise TrustboError(
            f"{len(failed)} of {len(runs)} runs failed; call run_grid again to repeat them. The "
            f"first errors are: {'; '.join(failed[:_N_SHOWN])}"
        )
    return pd.concat(map(_read, runs), ignore_index=True)


def _named(what: str, given: Any) -> dict[str, Any]:
    """Return cases or scenes with texts as names; raises TrustboError if two have one text."""
    require_kind(what, given, Mapping, "give a dict with a name for each")
    named = {str(name): one for name, one in given.items()}
    if len(named) < len(given):
        raise TrustboError(f"names of {what} must differ as texts; got {one_line(list(given))}.")
    return named


def _seeds_of(seeds: Any) -> list[int]:
    """Return seeds as a list; a number n stands for 0 to n - 1."""
    if isinstance(seeds, numbers.Integral):
        return list(range(require_count("seeds", seeds)))
    remedy = "give a number of seeds, or a list such as range(10)"
    return [
        require_whole(f"seeds[{k}]", seed, 0)
        for k, seed in enumerate(require_list("seeds", seeds, remedy=remedy))
    ]


def _plain(name: str) -> str:
    return re.sub(r"\W+", "-", composed(name))


def _read(run: _Run) -> pd.DataFrame:
    """Read the rows of a run; texts such as "NA" are kept, and names may look like numbers.

    Raises:
        TrustboError: The file is of another version, case or scene.
    """
    with interpreting(run.file):
        texts: Any = dict.fromkeys(("case", "scene", *run.identity), str)
        table = pd.read_csv(run.file, keep_default_na=False, na_values=[""], dtype=texts)
        stored = table.iloc[0].to_dict()

    changed = [name for name, value in run.identity.items() if stored.get(name) != value]
    if changed:
        raise TrustboError(
            f"{str(run.file)!r} was run with case {stored.get('case')!r}, scene "
            f"{stored.get('scene')!r} and trustbo {stored.get('trustbo')}. Changed since then: "
            f"{', '.join(changed)}. Use another name or folder, or delete the file to run it again."
        )
    return table.drop(columns=list(run.identity)).assign(case=run.case, scene=run.scene)


def _try(case: Case, scene: Callable[[], Scene], run: _Run, n_missions: int) -> str:
    """Run a campaign and write its rows to the file; return the error message, or ""."""
    try:
        with warnings.catch_warnings(), threadpool_limits(1):
            warnings.simplefilter("ignore")
            where = scene()
            options = case(where) if callable(case) else case
            rows = pd.DataFrame(_rows(options, where, run.seed, n_missions))

        names = {"case": run.case, "scene": run.scene, "seed": run.seed}
        rows = pd.DataFrame({**names, **where.labels}, rows.index).join(rows)
        write_text(run.file, rows.assign(**run.identity).to_csv(index=False))
    except Exception as error:  # an error in one run does not stop the others
        return f"{run.case}, {run.scene}, {run.seed}: {type(error).__name__}: {error}"
    return ""


def _rows(
    options: Mapping[str, Any], scene: Scene, seed: int, n_missions: int
) -> Iterator[dict[str, Any]]:
    """Run a campaign and yield its rows; the first is from before the first mission."""
    ends = (None, None) if scene.courses else scene.ends(0)
    options = {**scene.options, **copy.deepcopy(dict(options))}  # runs must not share a policy

    ground = (scene.workspace, *ends)
    with Campaign(*ground, seed=seed, directory=None, overwrite=False, **options) as campaign:
        policy: Any = campaign.policy
        yield {"mission": 0, **_recommended(campaign, scene, 0)}

        began = time.process_time()
        steps = campaign.run(scene.simulator, n_missions, courses=scene.courses or None)
        for number, (_, mission) in enumerate(steps, start=1):
            if hasattr(policy, "learn"):
                policy.learn(campaign, mission)
            seconds = time.process_time() - began

            contact_rate = campaign.state.entries[-1].measures["contact_rate"]
            yield {
                "mission": number,
                **_recommended(campaign, scene, number),
                "status": mission.status,
                "contact_rate": contact_rate,
                "measured": lost_in(mission),
                **_driven(mission.stations, scene, number - 1),
                "seconds": seconds,
            }
            began = time.process_time()


def lost_in(mission: Mission) -> float:
    """Return the contact lost in a mission as it was measured, in bounds.

    A bound that was completed loses 1 minus the mean contact rate of the measured robots; without
    any rate, it counts as the mean of the others. A bound that failed or was not reached loses 1.
    If no rate is known, the result is NaN.

    Example:
        >>> lost = [tb.study.lost_in(mission) for mission in result.missions]
    """
    done = np.array(mission.bound_status) == "ok"
    is_measured = done & np.isfinite(mission.contact_rate).any(axis=1)
    if not done.any():
        return float(len(mission.path) - 1)
    if not is_measured.any():
        return np.nan

    rates = np.nanmean(mission.contact_rate[is_measured], axis=1)
    n_unknown = int((done & ~is_measured).sum())
    return float(len(mission.path) - 1 - rates.sum() - n_unknown * rates.mean())


def _path_of(campaign: Campaign, scene: Scene, mission: int) -> Sequence[Cell]:
    """Return the path that a campaign, or its policy, recommends for a mission, from 0."""
    choose = getattr(campaign.policy, "recommend", None)
    if choose is None:
        return campaign.recommend(*scene.ends(mission)).stations
    if scene.courses:
        raise TrustboError(
            "a policy with a method recommend needs a scene with one course, or without a truth."
        )
    return choose(campaign)


def _recommended(campaign: Campaign, scene: Scene, mission: int) -> dict[str, float]:
    """Compute regret and loss of the path recommended before `mission`, an index from 0."""
    if scene.truth is None:
        return {}

    path = _path_of(campaign, scene, mission)
    truth = scene.truth.at(mission)
    best = truth.best(*scene.ends(mission), **scene.judged)
    regret = truth.regret(path, **scene.judged)
    return {"regret": regret, "lost": truth.lost(path), "best": truth.lost(best)}


def _driven(path: Sequence[Cell], scene: Scene, mission: int) -> dict[str, float]:
    """Compute the expected losses on the path of `mission`, an index from 0, and on the best."""
    if scene.truth is None:
        return {}

    truth = scene.truth.at(mission)
    ends = scene.ends(mission)
    best = truth.best(*ends, **scene.judged)
    safest = truth.best(*ends, **scene.judged, failures=True)
    return {
        "driven": truth.lost(path),
        "best_driven": truth.lost(best),
        "failed_driven": truth.lost_or_failed(path) - truth.lost_or_failed(safest),
    }
