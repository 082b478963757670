"""Reading of the folder of a campaign."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from trustbo.campaign.folder import earlier_from_tree
from trustbo.campaign.learning import as_learned
from trustbo.campaign.lock import FolderLock
from trustbo.campaign.record import (
    DIFFICULTY,
    EARLIER,
    RECORD,
    WORKSPACE,
    mission_file,
    read_record,
    require_no_missions_above,
    state_from_record,
)
from trustbo.campaign.replace import has_campaign, is_being_replaced, recover
from trustbo.campaign.result import Result
from trustbo.campaign.state import Entry, State
from trustbo.errors import TrustboError, require_switch, warn
from trustbo.files import FilePath, to_path
from trustbo.inference.classes import ClassLearner
from trustbo.inference.functions.known import is_of_function
from trustbo.inference.learner import Model, learner_from_record
from trustbo.inference.learns import Learner
from trustbo.logs.netcdf import missions_from_tree, read_tree
from trustbo.planning.plan import plan_from_record
from trustbo.workspace import Workspace
from trustbo.workspace.netcdf import restore_difficulty, workspace_from_tree


def lock_campaign(directory: FilePath) -> FolderLock:
    """Lock the folder of a campaign, and finish what a process began there before it died.

    An older campaign of this process that uses the folder is closed.

    Raises:
        TrustboError: The folder contains no campaign, or another process uses it.
    """
    lock = FolderLock(require_campaign(directory), take_over=True)
    try:
        recover(lock.path)
    except BaseException:
        lock.release()
        raise
    return lock


def read_campaign(directory: FilePath) -> tuple[State, Workspace, dict[str, str]]:
    """Read a campaign.

    Returns:
        The state, the workspace, and the hashes of the files that campaign.json lists.

    Raises:
        TrustboError: The folder contains no campaign, another version of trustbo wrote it, or a
            file is missing or damaged.
    """
    folder = require_campaign(directory)
    if is_being_replaced(folder):
        with FolderLock(folder) as lock:  # refused while somebody replaces it
            recover(lock.path)

    record = read_record(folder / RECORD)
    files: dict[str, str] = record["files"]
    n_missions = len(record["exclusions"])
    # The next number is left by a process that died before it recorded its mission.
    require_no_missions_above(folder, n_missions + 1, files)

    workspace = workspace_from_tree(read_tree(folder / WORKSPACE, files[WORKSPACE]))
    if DIFFICULTY in files and not _restore_difficulty(folder, workspace, files[DIFFICULTY]):
        del files[DIFFICULTY]

    awareness = record["settings"]["awareness"]
    entries = []
    for n in range(1, n_missions + 1):
        tree = read_tree(folder / mission_file(n), files[mission_file(n)])
        [measured] = missions_from_tree(tree)
        planned = tree["planned"].to_dataset()
        plan = plan_from_record(json.loads(planned.attrs["plan"]), workspace)
        learned = as_learned(measured, workspace, awareness)
        cause = planned.attrs["cause"]
        entries.append(Entry(plan, measured, learned, planned["trust_map"], cause))

    state = state_from_record(record, entries, folder, workspace)
    if EARLIER in files:
        earlier = earlier_from_tree(read_tree(folder / EARLIER, files[EARLIER]))
        state = replace(state, earlier=earlier)
    return state, workspace, files


def warn_of_unrecorded(folder: Path, n_missions: int) -> None:
    """Warn if there is a mission that a process wrote, but died before it recorded it."""
    file = folder / mission_file(n_missions + 1)
    if file.exists():
        warn(
            f"mission {n_missions + 1} was written to {str(file)!r}, but not recorded, as the "
            "process died. Unless you tell it anyway, read it with logs.read_missions and tell it."
        )


def _restore_difficulty(folder: Path, workspace: Workspace, sha256: str) -> bool:
    """Read the difficulty of bounds; warn and return False if the file cannot be read."""
    try:
        restore_difficulty(workspace, read_tree(folder / DIFFICULTY, sha256))
    except TrustboError as error:  # it can be measured again
        warn(f"{error} The difficulty of bounds will be measured again.")
        return False
    return True


def require_campaign(directory: FilePath) -> Path:
    """Return the path of a folder; raises TrustboError if it contains no campaign."""
    path = to_path(directory)
    try:
        found = has_campaign(path)
    except OSError:
        found = False
    if not found:
        raise TrustboError(f"{str(directory)!r} contains no campaign; give another folder.")
    return path


def load_result(
    directory: FilePath, *, model: Model | None = None, progress: bool = True
) -> Result:
    """Read the result of a campaign from its folder, without locking the folder.

    The campaign may still be running in another process.

    Args:
        directory: Folder of a campaign, or a folder written by `Result.save`.
        model: Model of the campaign; needed if it is a NumPyro function, or if a prior has a class
            of your own and nothing has been learned.
        progress: Whether to show a progress bar if `posterior` takes longer than 1.5 seconds.

    Raises:
        TrustboError: The folder contains no campaign, the campaign has no mission yet, or a file is
            missing or damaged.

    Example:
        >>> result = tb.load_result("hills")
        >>> result.table()
    """
    require_switch("progress", progress)
    state, workspace, _ = read_campaign(directory)
    if not state.entries and not state.earlier.missions:
        raise TrustboError(f"the campaign in {str(directory)!r} has no mission; run one first.")

    learner = _learner_of(state, model)
    result = Result(workspace, state, learner)
    result._progress = progress
    return result


def _learner_of(state: State, model: Model | None) -> Learner:
    """Return the learner of a stored campaign, whose model may be given."""
    record: dict[str, Any] = state.settings["model_record"]
    try:
        return learner_from_record(record, model)
    except TrustboError:
        # A model class with priors of own classes is needed only if nothing has been learned.
        if state.last is None or model is not None or is_of_function(record):
            raise
        return ClassLearner(None)
