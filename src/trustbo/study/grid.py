"""Grids of campaigns (cases x scenes x seeds) that run in parallel and can be resumed."""

import copy
import re
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from trustbo.files import FilePath, to_path, write_text
from trustbo.simulation import Truth
from trustbo.simulation.protocol import Simulator
from trustbo.study.record import (
    describe_scene,
    described,
    read_record,
    require_same,
    source_of,
    write_record,
)
from trustbo.workspace import Workspace

_MAX_JOBS = 10**6
"""Largest number of processes that joblib may leave free (a negative `n_jobs`)."""
_N_SHOWN = 3
"""Number of runs whose errors the message contains."""
_SET = ("workspace", "start", "goal", "directory", "overwrite")
"""Arguments of `Campaign`, besides the seed, that cases and scenes cannot set."""


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

    Each run writes a CSV file whose name contains the case, scene, seed and number of missions, and
    a JSON file beside it that records the version of trustbo, the options of the case and the
    content of the scene. A run is skipped if its files exist; if the record differs from the
    present case or scene, `run_grid` raises an error. A scene, or a case that is a function, is
    made and compared only if its function has changed: its code, functions and classes of the same
    module that it uses, or values to which it refers. Changes in files and in other modules are
    therefore not noticed; use another folder after such changes.

    Runs are parallelised with joblib; `joblib.parallel_config` selects another backend, such as
    `backend="dask"` for a cluster. If the policy has a method `learn(campaign, mission)`, it is
    called after each mission. If the policy has a method `recommend(campaign)`, its path replaces
    the campaign's recommendation.

    Args:
        cases: Cases, keyed by name.
        scenes: Functions, keyed by name, that make the scenes in the worker processes.
        folder: Folder for the files of the runs.
        seeds: Seeds of the campaigns, without repeats.
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
        TrustboError: A run failed (call the function again to repeat failed runs), a stored run had
            other options or another scene, or a case or scene sets an argument of `Campaign` that
            `run_grid` sets, such as the seed.

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

    if len(set(seeds)) < len(seeds):
        raise TrustboError(f"seeds must differ from each other; got {seeds}.")
    for name, case in cases.items():
        if not callable(case):
            _require_free(f"case {name!r}", case)

    root = to_path(folder)
    files = {
        _Run(case, scene, seed): root / f"{_plain(case)}~{_plain(scene)}~{seed}~{n_missions}.csv"
        for seed, scene, case in product(seeds, scenes, cases)
    }

    # Some file systems ignore the case of letters.
    if len({str(file).casefold() for file in files.values()}) < len(files):
        raise TrustboError(
            "names of cases, and of scenes, must differ in more than punctuation and the case of "
            "letters; rename one."
        )

    known = _known(cases, scenes, files)
    _require_as_stored(cases, scenes, files, known, n_jobs)
    errors = Parallel(n_jobs=n_jobs)(
        delayed(_run)(cases[run.case], scenes[run.scene], run, n_missions, file, known[run])
        for run, file in files.items()
        if not file.exists()
    )

    failed = [error for error in errors if error]
    if failed:
        raise TrustboError(
            f"{len(failed)} of {len(files)} runs failed; call run_grid again to repeat them. The "
            f"first errors are: {'; '.join(failed[:_N_SHOWN])}"
        )
    return pd.concat([_read(file, run) for run, file in files.items()], ignore_index=True)


class _Run(NamedTuple):
    """Name of a run."""

    case: str
    scene: str
    seed: int


class _Known(NamedTuple):
    """What is known of a run before its scene is made."""

    sources: dict[str, str | None]
    """Hashes of the functions of the `case` and the `scene`."""
    options: Any
    """Description of the options of the case; None if the case is a function."""


def _known(
    cases: Mapping[str, Case], scenes: Mapping[str, Callable[[], Scene]], runs: Iterable[_Run]
) -> dict[_Run, _Known]:
    """Describe each run without making its scene; in this process, because hashes may differ."""
    options = {name: None if callable(case) else described(case) for name, case in cases.items()}
    of_cases = {name: source_of(case) for name, case in cases.items()}
    of_scenes = {name: source_of(scene) for name, scene in scenes.items()}
    return {
        run: _Known({"case": of_cases[run.case], "scene": of_scenes[run.scene]}, options[run.case])
        for run in runs
    }


def _require_free(what: str, options: Any) -> None:
    """Raise TrustboError unless options are a dict without the arguments that `run_grid` sets."""
    require_kind(what, options, Mapping, "give a dict of options of Campaign")
    if "seed" in options:
        raise TrustboError(
            f"{what} has the seed {options['seed']!r}, so all its runs would be the same; seeds "
            "belong in seeds=."
        )
    for option in _SET:
        if option in options:
            raise TrustboError(
                f"{what} has the option {option!r}, which run_grid sets for each run; leave it out."
            )


def _require_as_stored(
    cases: Mapping[str, Case],
    scenes: Mapping[str, Callable[[], Scene]],
    files: Mapping[_Run, Path],
    known: Mapping[_Run, _Known],
    n_jobs: int,
) -> None:
    """Raise TrustboError if a stored run had other options or another scene than now.

    Scenes, and the options of cases that are functions, are made only if a function has changed.
    """
    records = {
        run: read_record(file, run._asdict()) for run, file in files.items() if file.exists()
    }

    doubtful: dict[str, list[_Run]] = {}  # runs, keyed by the scene that must be made
    for run, record in records.items():
        if known[run].options is not None:
            _require_same_case(run, record, known[run].options)
        if record["sources"] != known[run].sources:
            doubtful.setdefault(run.scene, []).append(run)

    made: Any = Parallel(n_jobs=n_jobs)(
        delayed(_contents)({run.case: cases[run.case] for run in runs}, scenes[scene], scene)
        for scene, runs in doubtful.items()
    )
    for runs, contents in zip(doubtful.values(), made, strict=True):
        for run in runs:
            now = contents[run.case]
            stored = records[run]["content"]["scene"]
            require_same(f"scene {run.scene!r} had other contents", stored, now["scene"])
            if known[run].options is None:
                _require_same_case(run, records[run], now["case"])


def _require_same_case(run: _Run, record: Mapping[str, Any], options: Mapping[str, Any]) -> None:
    """Raise TrustboError unless a stored run had these options, as from `described`."""
    what = f"case {run.case!r} was run with other options"
    require_same(what, record["content"]["case"], options)


def _contents(
    cases: Mapping[str, Case], scene: Callable[[], Scene], name: str
) -> dict[str, dict[str, Any]]:
    """Make a scene, and describe it and the options of cases in it, keyed by case."""
    try:
        with warnings.catch_warnings(), threadpool_limits(1):
            warnings.simplefilter("ignore")
            where = scene()
            return {case: _content(_options(case, cases[case], where), where) for case in cases}
    except Exception as error:
        raise TrustboError(
            f"scene {name!r} cannot be made to compare it with its stored runs: "
            f"{type(error).__name__}: {error}"
        ) from error


def _content(options: Mapping[str, Any], scene: Scene) -> dict[str, Any]:
    """Describe the options of a case and its scene for the record of a run."""
    return {"case": described(options), "scene": describe_scene(scene)}


def _options(name: str, case: Case, scene: Scene) -> Mapping[str, Any]:
    """Return the options of a case in a scene."""
    _require_free("the scene", scene.options)
    if not callable(case):
        return case

    options = case(scene)
    _require_free(f"case {name!r}", options)
    return options


def _plain(name: str) -> str:
    return re.sub(r"\W+", "-", composed(name))


def _read(file: Path, run: _Run) -> pd.DataFrame:
    """Read the rows of a run; texts such as "NA" are kept, and names may look like numbers."""
    table = pd.read_csv(file, keep_default_na=False, na_values=[""])
    return table.assign(**run._asdict())


def _run(
    case: Case,
    scene: Callable[[], Scene],
    run: _Run,
    n_missions: int,
    file: Path,
    known: _Known,
) -> str:
    """Run a campaign and write its rows and its record; return the error message, or ""."""
    try:
        with warnings.catch_warnings(), threadpool_limits(1):
            warnings.simplefilter("ignore")
            where = scene()
            options = _options(run.case, case, where)
            content = _content(options, where)  # before the campaign changes a policy
            if known.options is not None:
                content["case"] = known.options
            rows = [
                run._asdict() | dict(where.labels) | row
                for row in _rows(options, where, run.seed, n_missions)
            ]

        # The table is last, because a run counts as stored if its table exists.
        write_record(file, run._asdict(), known.sources, content)
        write_text(file, pd.DataFrame(rows).to_csv(index=False))
    except Exception as error:  # an error in one run does not stop the others
        return f"{', '.join(map(str, run))}: {type(error).__name__}: {error}"
    return ""


def _rows(
    options: Mapping[str, Any], scene: Scene, seed: int, n_missions: int
) -> Iterator[dict[str, Any]]:
    """Run a campaign and yield its rows; the first is from before the first mission."""
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
