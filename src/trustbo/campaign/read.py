"""Reading of the folder of a campaign."""

import json
from pathlib import Path

from trustbo.campaign.earlier import earlier_from_tree
from trustbo.campaign.learning import as_learned
from trustbo.campaign.lock import FolderLock
from trustbo.campaign.record import (
    DIFFICULTY,
    EARLIER,
    RECORD,
    WORKSPACE,
    mission_file,
    mission_files,
    posterior_file,
    record_from_bytes,
    state_from_record,
)
from trustbo.campaign.replace import has_campaign, is_being_replaced, recover
from trustbo.campaign.state import Entry, Posterior, State, StoredFile
from trustbo.errors import TrustboError, warn
from trustbo.files import FilePath, interpreting, read_file, to_path
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
    path = require_campaign(directory)
    lock = FolderLock(path, take_over=True)
    try:
        recover(lock.path)
    except BaseException:
        lock.release()
        raise
    return lock


def read_campaign(
    directory: FilePath,
) -> tuple[State, Workspace, list[Entry], dict[str, str]]:
    """Read a campaign.

    Returns:
        The state, the workspace, the missions that are not in campaign.json yet, and the hashes of
        the files that campaign.json lists.

    Raises:
        TrustboError: The folder contains no campaign, another version of trustbo wrote it, or a
            file is missing or damaged.
    """
    folder = require_campaign(directory)
    if is_being_replaced(folder):
        with FolderLock(folder) as lock:  # refused while somebody replaces it
            recover(lock.path)

    path = folder / RECORD
    record = record_from_bytes(read_file(path), path)
    with interpreting(path):
        files = {str(name): str(sha256) for name, sha256 in record["files"].items()}
        rows = [dict(row) for row in record["rows"]]
        names = [None if name is None else str(name) for name in record["posteriors"]]
        initial = record["initial"]
        stored = {}
        for name in [initial, *names]:
            if name is not None:
                file = posterior_file(name)
                stored[name] = Posterior(name, file=StoredFile(folder / file, files[file]))

    tree = read_tree(folder / WORKSPACE, files.get(WORKSPACE, ""))
    with interpreting(folder / WORKSPACE):
        workspace = workspace_from_tree(tree)
    if DIFFICULTY in files and not _restore_difficulty(folder, workspace, files[DIFFICULTY]):
        del files[DIFFICULTY]

    with interpreting(path):
        state = state_from_record(record, workspace)
    state.initial = None if initial is None else stored[initial]

    if EARLIER in files:
        tree = read_tree(folder / EARLIER, files[EARLIER])
        with interpreting(folder / EARLIER):
            state.earlier = earlier_from_tree(tree)

    awareness = state.settings["awareness"]
    entries = _read_entries(folder, workspace, awareness, files, len(rows))
    for entry, row, name in zip(entries, rows, names, strict=False):
        entry.row = row
        entry.posterior = None if name is None else stored[name]

    state.entries = entries[: len(rows)]
    return state, workspace, entries[len(rows) :], files


def _restore_difficulty(folder: Path, workspace: Workspace, sha256: str) -> bool:
    """Read the difficulty of bounds; warn and return False if the file cannot be read."""
    try:
        tree = read_tree(folder / DIFFICULTY, sha256)
        with interpreting(folder / DIFFICULTY):
            restore_difficulty(workspace, tree)
    except TrustboError as error:  # it can be measured again
        warn(f"{error} The difficulty of bounds will be measured again.")
        return False
    return True


def _read_entries(
    folder: Path, workspace: Workspace, awareness: str, files: dict[str, str], n_rows: int
) -> list[Entry]:
    """Read the missions of a folder, of which campaign.json lists `n_rows`.

    Raises TrustboError if one is missing.
    """
    there = mission_files(folder)
    n_last = int(there[-1].stem) if there else 0
    entries = []
    for n in range(1, max(n_rows, n_last) + 1):
        name = mission_file(n)
        file = folder / name
        if not file.exists() and n > n_rows:
            raise TrustboError(
                f"{str(file)!r} is missing, although {there[-1].name} exists. Restore it, or move "
                "the later missions to another folder."
            )

        tree = read_tree(file, files.get(name, ""))
        with interpreting(file):
            [measured] = missions_from_tree(tree)
            planned = tree["planned"].to_dataset()
            plan = plan_from_record(json.loads(planned.attrs["plan"]), workspace)
            row = json.loads(planned.attrs["row"])
            learned = as_learned(measured, workspace, awareness)

        entries.append(Entry(plan, measured, learned, planned["trust_map"], row))
    return entries


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
