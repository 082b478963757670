"""Records of a campaign's folder, checked field by field; and the remedy for a damaged file."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from trustbo.campaign.replacing import MEASURED, MISSIONS, RESULT, STATE
from trustbo.errors import DamagedFileError
from trustbo.files import read_record

MISSIONS_AS_TOLD = (
    "All missions as they were told can be read: trustbo.logs.read_missions({!r}); tell them, in "
    "order, to a new campaign in another folder, with other_path=True."
)
_MISSIONS_FILLED = (
    "The missions can be read: trustbo.logs.read_missions({!r}); tell them, in order, to a new "
    "campaign in another folder, with other_path=True. They are not quite as they were told: "
    "awareness that was not measured is filled in there from the map or the belief. A campaign "
    "with awareness='belief' would take it for measured, and be too sure of its map; with "
    "awareness='map' nothing changes."
)

# Kinds of values: a type (float for any number), alternatives in a tuple, a list of one kind or of
# one for each place, and a dict of those by name, `str` for all other names.
_COUNT, _PATH = range(1_000_000), [[int, int]]
_AFTER = [(_COUNT, None)]
_CHOSEN = {
    "start": [int, int], "goal": [int, int], "objective": str, "sampler": str, "policy": str,
    "connectivity": int, "max_bounds": (int, str, None), "team": str, "length_weight": float,
    "unseen_cost": float, "max_failure": (float, None), "failure_cost": (float, None),
    "initial": str, "forgetting": float, "awareness": str, "replan": str,
    "hazard": dict,
}  # fmt: skip
_PLAN = {
    "path": _PATH, "positions": [[float, float]], "length": float, "trust": [[float]],
    "bands": [[[float]]], "value": float, "success_index": float,
    "objective": str, "exact": bool, "bound": float, "revisits": int, "engine": str,
    "seconds": float, "infeasible": bool, "value_band": ([float, float], None),
    "cover": (None, {"unseen": float, "band": [float, float], "by_bound": [float]}),
    "unseen_toll": float,
    "risk": (None, {
        "p_fail": [float], "p_fail_band": [[float]], "p_arrive": float,
        "p_arrive_band": [float, float], "by_cause": {str: [float]}, "p_reach": [float],
    }),
}  # fmt: skip
_FAILURE = [int, str, _PATH, ([int, int], None), bool]
_FAILURES = [_FAILURE]
_COLUMNS = "objective", "path_changed", "contact_rate", "status"
_ROW = {"status": str, "state": str, "reason": str, str: (float, bool)}
_NEEDED = {
    STATE: (
        "n_missions",
        "options",
        "plans",
        "rows",
        "posterior_after",
        "failures",
        "notes",
        "stop_reason",
    ),
    RESULT: (
        "n_missions",
        "path",
        "trust",
        "value",
        "settings",
        "posterior_after",
        "failures",
        "stop_reason",
    ),
}
_FIELDS: dict[str, dict[Any, Any]] = {
    STATE: {
        "n_missions": _COUNT,
        "options": _CHOSEN | {"model": dict, "own_policy": bool, "own_awareness": bool},
        "suggested": (_PLAN, None),
        "plans": [_PLAN],
        "rows": [_ROW],
        "posterior_after": _AFTER,
        "failures": _FAILURES,
        "notes": {"simulator": str, "n_iterations": _COUNT, "stop": [dict]},
        "stop_reason": str,
    },
    RESULT: {
        "n_missions": _COUNT,
        "path": _PATH,
        "trust": [[float]],
        "value": float,
        "settings": _CHOSEN | {"model": str, "simulator": str, "response": str},
        "posterior_after": _AFTER,
        "failures": _FAILURES,
        "stop_reason": str,
    },
}


def read_fields(file: Path) -> dict[str, Any]:
    """Read `campaign.json` or `result.json`.

    DamagedFileError: the file is missing or damaged, or a field is missing or no such value.
    """
    record = read_record(file)

    def damaged(reason: str) -> DamagedFileError:
        return DamagedFileError(f"{str(file)!r} is damaged: {reason}")

    if not isinstance(record, dict):
        raise damaged("no record of fields.")
    if missing := [name for name in _NEEDED[file.name] if name not in record]:
        raise damaged(f"it lacks {', '.join(missing)}.")
    for name, kind in _FIELDS[file.name].items():
        if name in record and not _fits(record[name], kind):
            raise damaged(f"{name} = {str(record[name])[:60]} is none.")
    for row in record.get("rows", []):
        if lacks := [name for name in _COLUMNS if name not in row]:
            raise damaged(f"a mission lacks {', '.join(lacks)}.")
    n = record["n_missions"]
    for name in ("plans", "rows", "posterior_after"):
        if len(record.get(name, range(n))) != n:
            raise damaged(f"{name} has {len(record[name])} entries for {n} missions.")
    return record


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value is of a kind."""
    match kind:
        case tuple():
            return any(_fits(value, choice) for choice in kind)
        case range():
            return _fits(value, int) and value in kind
        case [every]:
            return isinstance(value, list) and all(_fits(v, every) for v in value)
        case list():
            same_length = isinstance(value, list) and len(value) == len(kind)
            return same_length and all(map(_fits, value, kind))
        case dict():
            return isinstance(value, dict) and all(
                _fits(v, kind.get(name, kind.get(str, object))) for name, v in value.items()
            )
        case None:
            return value is None
    if kind in (int, float):  # a bool is an int, and an int beyond 64 bits no number of ours
        whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 1 << 63
        return whole or (kind is float and isinstance(value, float))
    return isinstance(value, kind)


@contextmanager
def naming_what_is_left(folder: Path) -> Iterator[None]:
    """Add to the error of a damaged file that the missions can be read, if they can."""
    try:
        yield
    except DamagedFileError as error:
        for name, remedy in ((MEASURED, MISSIONS_AS_TOLD), (MISSIONS, _MISSIONS_FILLED)):
            if str(folder / name) not in str(error) and (folder / name).exists():
                raise DamagedFileError(f"{error} {remedy.format(str(folder / name))}") from None
        raise
