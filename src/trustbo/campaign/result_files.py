"""Files of a result: written with a campaign or alone, and read back."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from trustbo.campaign.damage import naming_what_is_left, read_fields
from trustbo.campaign.failures import Failure
from trustbo.campaign.migrate import migrate_result
from trustbo.campaign.posteriors import Posterior, Posteriors, kept_of
from trustbo.campaign.replacing import (
    BELIEVED,
    HISTORY,
    MISSIONS,
    POSTERIOR,
    POSTERIORS,
    RESULT,
    STATE,
    TABLE,
    WORKSPACE,
    current,
    held,
    replacing,
)
from trustbo.campaign.result import Result
from trustbo.campaign.state import Kept
from trustbo.errors import DamagedFileError, TrustboError
from trustbo.files import (
    FilePath,
    as_path,
    interpreting,
    require_folder,
    to_json,
    write_checked,
    write_text,
)
from trustbo.logs.netcdf import read_missions, read_tree, write_missions, write_tree
from trustbo.spreadsheet import frame_as_csv
from trustbo.workspace import Workspace
from trustbo.workspace import netcdf as archive
from trustbo.workspace.moves import require_on_grid


def save_result(result: Result, directory: FilePath) -> None:
    """Write a result to a folder, see `Result.save`."""
    folder = require_folder(directory)
    held_there = current(folder)
    if (held_there / STATE).exists():
        if not _is_in(result, held_there):
            raise TrustboError(
                f"{str(folder)!r} holds a campaign, with missions as they were told, which a "
                "result does not have; give another folder."
            )
        whole = held_there / POSTERIOR
        if result.has_posterior and not whole.exists():  # written when a campaign ends
            write_tree(whole, result.posterior)
        return
    with held(folder), replacing(folder) as new:
        write_tree(new / WORKSPACE, archive.workspace_to_tree(result.workspace))
        write_result(result, new, whole=True, home=folder)
        if result.has_posterior:
            write_tree(new / POSTERIOR, result.posterior)
    mark_kept(result, folder)


def mark_kept(result: Result, home: Path) -> None:
    """Record that the posteriors are in a folder, all of them, from where they are read."""
    for kept in kept_of(result.posteriors):
        if kept:
            kept.file = home / _posterior_file(kept.after)


def write_result(result: Result, folder: Path, *, whole: bool, home: Path) -> None:
    """Write all but the workspace of a result.

    Args:
        result: Result of the missions so far.
        folder: Folder to write to.
        whole: Whether to write all missions, or only the last to a folder that has all before it:
            earlier posteriors never change.
        home: Folder that the files will be in; another where they replace what is there, and
            `mark_kept` is to be called once they did.
    """
    files = list({kept.after: kept for kept in kept_of(result.posteriors) if kept}.values())
    for kept in files if whole else files[-2:]:  # the last but one may have shrunk
        name = _posterior_file(kept.after)
        if whole or home / name != kept.file:
            write_tree(folder / name, kept())
            if folder == home:
                kept.file = home / name  # it is there from now on
    since = 0 if whole else len(result.missions)  # whose ticks are there
    write_missions(folder / MISSIONS, result.missions, since=since)
    history = result.history.assign(final_trust_map=result.trust_map)
    write_tree(folder / HISTORY, xr.DataTree(history))
    if result.believed is not None:
        write_tree(folder / BELIEVED, xr.DataTree(result.believed))
    write_text(folder / TABLE, frame_as_csv(result.table()))
    # Written last: its presence means that the rest is complete.
    write_checked(folder / RESULT, to_json(_record_of(result)).encode())


def _record_of(result: Result) -> dict[str, Any]:
    """Everything that no other file holds."""
    return {
        "n_missions": len(result.missions),
        "path": result.path,
        "trust": result.trust.tolist(),
        "value": result.value,
        "settings": result.settings,
        "stop_reason": result.stop_reason,
        "posterior_after": [kept and kept.after for kept in kept_of(result.posteriors)],
        **({"failures": result.failures} if result.failures else {}),
    }


def _is_in(result: Result, folder: Path) -> bool:
    """Whether a folder holds this very result."""
    own = migrate_result(json.loads(to_json(_record_of(result))))
    try:
        return to_json(read_fields(folder / RESULT)) == to_json(own)
    except DamagedFileError:
        return False


def load_result(directory: FilePath) -> Result:
    """Read a result that `Result.save` wrote.

    Args:
        directory: Folder that it was written to.

    Raises:
        TrustboError: The folder holds no result.
        DamagedFileError: A file is missing or damaged; the message says what can be read.
    """
    folder = current(as_path(directory))
    if not (folder / RESULT).exists():
        raise TrustboError(f"{str(directory)!r} holds no result; give a folder written by save().")
    with naming_what_is_left(folder):
        record = read_fields(folder / RESULT)
        # A run killed while it saved may have left one mission more than the record counts.
        missions, posteriors, history = read_kept(folder, record)
        workspace, believed = read_workspace(folder), None
        if record["settings"].get("awareness") == "belief":
            believed = read_tree(folder / BELIEVED).to_dataset()
        with interpreting(folder / HISTORY):
            trust_map = history["final_trust_map"].rename("trust")
            history = history.drop_vars("final_trust_map")
        with interpreting(folder / RESULT):
            trust = np.array(record["trust"], dtype=float)
            path = require_on_grid(record["path"], workspace.grid.shape)
            if trust.shape != (len(path) - 1, workspace.awareness.sizes["robot"]):
                raise ValueError(f"trust of shape {trust.shape} along {len(path)} cells")
            failures = tuple(Failure.restore(one) for one in record["failures"])
        return Result(
            workspace,
            missions,
            posteriors,
            list(path),
            trust,
            record["value"],
            trust_map,
            history,
            record["settings"],
            record["stop_reason"],
            believed,
            failures,
        )


def read_kept(folder: Path, record: dict[str, Any]) -> Kept:
    """Read the missions that a record counts, their posteriors and the history."""
    n, order = record["n_missions"], record["posterior_after"]
    kept: dict[int, Posterior] = {}
    for after in {*order} - {None}:
        file = folder / _posterior_file(after)
        if not file.exists():
            raise DamagedFileError(f"{str(file)!r} is missing.")
        kept[after] = Posterior(after, file=file)
    history, missions = read_tree(folder / HISTORY).to_dataset(), folder / MISSIONS
    with interpreting(folder / HISTORY):
        history = history.isel(iteration=slice(n))
        if (rows := history.sizes["iteration"]) != n:
            raise ValueError(f"{rows} missions of {n}")
    filled = read_missions(missions)[:n]
    if len(filled) != n:
        raise DamagedFileError(f"{str(missions)!r} holds {len(filled)} missions of {n}.")
    return Kept(filled, Posteriors(kept.get(after) for after in order), history)


def read_workspace(folder: Path) -> Workspace:
    """Read the workspace of a campaign or result; DamagedFileError if it is missing or damaged."""
    tree = read_tree(folder / WORKSPACE)
    with interpreting(folder / WORKSPACE):
        return archive.workspace_from_tree(tree)


def _posterior_file(after: int) -> Path:
    return Path(POSTERIORS) / f"{after:04d}.nc"
