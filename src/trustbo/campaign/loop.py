"""Run whole campaigns in a simulator, and resume them."""

import inspect
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from trustbo.campaign.campaign import Campaign
from trustbo.campaign.stopping import Stop
from trustbo.errors import TrustboError, require_switch
from trustbo.files import FilePath
from trustbo.inference.learner import Model
from trustbo.planning.policies import Policy
from trustbo.simulation.protocol import Simulator
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Location


def iterate(
    workspace: Workspace,
    start: Location | None = None,
    goal: Location | None = None,
    *,
    courses: Sequence[Sequence[Location]] | None = None,
    n_iterations: int = 8,
    simulator: Simulator | None = None,
    stop: Stop | None = None,
    directory: FilePath | None = None,
    overwrite: bool = False,
    progress: bool = True,
    **options: Any,
) -> Campaign:
    """Run a campaign in a simulator: plan a path, run it, learn from the contact, and repeat.

    Args:
        workspace: Workspace of the paths.
        start: First cell (row, col), with row 0 in the north, or a position in this cell, such as
            `{"x": 1748000, "y": 5427000}` in CRS metres; see `Workspace.locate`.
        goal: Last cell, or a position in this cell.
        courses: Start and goal of each mission, instead of `start` and `goal`; mission k has the
            course k modulo the number of courses.
        n_iterations: Maximum number of missions.
        simulator: Simulator with `run(path, *, seed, mission) -> Mission`; by default
            `KinematicSimulator(workspace)`, or `RealtimeAwareness` of it if `awareness="measured"`.
        stop: Stopping rule, called between missions: a `RegretBound`, or a function of the campaign
            that returns a reason or None.
        directory: Folder that is updated after each mission. If the process dies, `resume`
            continues from it.
        overwrite: Whether to replace an existing campaign in that folder.
        progress: Whether to show a progress bar.
        **options: Further arguments of `Campaign`: `model`, `policy`, `objective`, `sampler`,
            `seed`, `initial`, `awareness`, `hazard`, `planner`, `fit` and `earlier`.

    Returns:
        Campaign after the last mission; its properties are the results. A campaign with a
        `directory` has been closed.

    Raises:
        TrustboError: The input is invalid or the folder has a campaign; raised before any work.
        NoPathError: The goal cannot be reached.
        TypeError: There is no such argument.

    Example:
        >>> result = tb.iterate(workspace, start=(9, 0), goal=(0, 9), n_iterations=8)
        >>> result.path
        >>> courses = [((9, 0), (0, 9)), ((0, 0), (9, 9))]
        >>> tb.iterate(workspace, courses=courses, n_iterations=2).table()[["start", "goal"]]
    """
    require_switch("overwrite", overwrite)
    require_switch("progress", progress)
    _require_arguments(options)
    if (start is None and goal is None) == (courses is None):
        raise TrustboError("give start and goal, or courses=[(start, goal), ...], and not both.")
    campaign = Campaign(workspace, start, goal, progress=progress, **options)
    steps = campaign.run(simulator, n_iterations, courses=courses, stop=stop, progress=progress)
    with campaign:
        if directory is not None:  # after all input has been checked
            campaign.store_in(directory, overwrite=overwrite)
        for _ in steps:
            pass
    return campaign


def _require_arguments(options: Mapping[str, Any]) -> None:
    """Raise TypeError for options of `iterate` that are no arguments of it or of `Campaign`."""
    known = [*inspect.signature(iterate).parameters, *inspect.signature(Campaign).parameters]
    for name in options:
        if name not in known:
            closest = get_close_matches(name, known, n=1)
            remedy = f"; did you mean {closest[0]!r}?" if closest else ""
            raise TypeError(f"iterate() got an unexpected keyword argument {name!r}{remedy}")


def resume(
    directory: FilePath,
    *,
    simulator: Simulator | None = None,
    n_iterations: int | None = None,
    model: Model | None = None,
    policy: Policy | None = None,
    stop: Stop | None = None,
    progress: bool = True,
) -> Campaign:
    """Continue a campaign that `iterate(directory=...)` began, with identical results.

    If a stopping rule ended the campaign, no mission is run unless you pass `stop` or ask for more
    missions. Stopping rules are not stored and must be given again.

    Args:
        directory: Folder of the campaign.
        simulator: Simulator of the campaign; required unless it was the default.
        n_iterations: Total number of missions, earlier ones included; by default as before.
        model: Model of the campaign, if it is custom; see `Campaign.load`.
        policy: Policy of the campaign, if it is custom.
        stop: Stopping rule, as in `iterate`.
        progress: Whether to show a progress bar.

    Raises:
        TrustboError: The folder contains no campaign or is locked by another process, the model,
            policy or simulator differs from the original, or a file is missing or damaged.

    Example:
        >>> campaign = tb.resume("hills", n_iterations=2)
        >>> len(campaign.missions)
        2
    """
    require_switch("progress", progress)
    with Campaign.load(directory, model=model, policy=policy, progress=progress) as campaign:
        state = campaign.state
        before = state.simulation
        if state.entries and not before and simulator is None:
            raise TrustboError(
                f"{str(directory)!r} was not simulated; use Campaign.load, or give simulator=."
            )

        ended = state.stop_reason not in ("interrupted", "n_iterations")
        if ended and stop is None and (n_iterations or 0) <= len(state.entries):
            return campaign

        total = before.get("n_iterations", 8) if n_iterations is None else n_iterations
        courses = before.get("courses")
        steps = campaign.run(simulator, total, courses=courses, stop=stop, progress=progress)

        for name, value in campaign.state.simulation.items():
            if name in ("n_iterations", "courses"):
                continue
            if repr(before.get(name, value)) != repr(value):
                raise TrustboError(
                    f"simulator: the campaign was run with {name} = {before[name]!r}, not "
                    f"{value!r}; give the same simulator."
                )

        for _ in steps:
            pass
    return campaign
