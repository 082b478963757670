"""Masks of areas that have changed: rates measured there before the change are left out.

An area is masked once it is more probable than not that some area has changed, by a tenth of
contact or more, from some mission on (`inference.changes`). What is there now is then learned anew:
its older rates are of another world, and a column for the change would take the rest of the area
for known (4 % regret against 1 % in the worlds it was tried on). The first start is final: after it
is masked, an area has no rates left that a later scan could date it by.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.changes import scan_posterior, why_no_changes
from trustbo.models.effects.change import Change
from trustbo.models.model import TrustModel
from trustbo.workspace import Workspace

_PROBABLE, _LEAST = 0.5, 1e-3  # probability: of a change, and of one that is looked at


class Mask(NamedTuple):
    """An area, and the first mission whose rates there are learned from."""

    row: int
    col: int
    radius: int
    first: int

    def holds(self, cells: np.ndarray) -> np.ndarray:
        """Whether cells (..., 2) are in the area."""
        return Change("area", tuple(self[:3]), self.first).met(cells)

    def __str__(self) -> str:
        """Text of what is left out."""
        area = f"area within {self.radius} of ({self.row}, {self.col})"
        return f"{area} has changed: its rates before mission {self.first + 1} are left out"


def masks_of(posterior: xr.DataTree | None) -> list[Mask]:
    """Masks that a posterior of a campaign was fitted under."""
    numbers = [] if posterior is None else posterior.attrs.get("masks", [])
    return [Mask(*mask.tolist()) for mask in np.reshape(numbers, (-1, 4)).astype(int)]


def mission_numbers(posterior: xr.DataTree) -> list[int]:
    """Numbers in the campaign, from 0, of the missions that a posterior was fitted to."""
    return np.atleast_1d(posterior.attrs["missions"]).astype(int).tolist()


def masked(
    missions: Sequence[Mission], numbers: Sequence[int], masks: Sequence[Mask]
) -> list[Mission]:
    """Missions without the rates that masks leave out.

    Args:
        missions: Missions to learn from.
        numbers: Their numbers in the campaign, from 0.
        masks: Masks.
    """
    pairs = zip(missions, numbers, strict=True)
    return [_masked(mission, [m for m in masks if j < m.first]) for mission, j in pairs]


def _masked(mission: Mission, masks: Sequence[Mask]) -> Mission:
    cells = np.array([bound.cell for bound in mission.bounds])
    left_out = np.zeros(len(cells), dtype=bool)
    for mask in masks:
        left_out |= mask.holds(cells)
    if left_out.all() or not left_out.any():  # a mission without rates could not be learned
        return mission
    bounds = [
        replace(bound, contact_rate=np.full_like(bound.contact_rate, np.nan)) if out else bound
        for bound, out in zip(mission.bounds, left_out, strict=True)
    ]
    return replace(mission, bounds=tuple(bounds))


def find_mask(
    posterior: xr.DataTree,
    missions: Sequence[Mission],
    numbers: Sequence[int],
    workspace: Workspace,
    model: TrustModel,
    masks: Sequence[Mask],
) -> Mask | None:
    """Mask of the most probable change of an area; None where none is more probable than not.

    Args:
        posterior: Posterior of the missions, under the masks so far.
        missions: Missions that it was fitted to, masked.
        numbers: Their numbers in the campaign, from 0.
        workspace: Workspace of the campaign.
        model: Model of the campaign.
        masks: Masks so far; areas that overlap with theirs are not masked from an earlier mission.
    """
    weighed = scan_posterior(posterior, missions, workspace, model=model)
    found, p = [], 0.0
    for i in np.flatnonzero(weighed.large & (weighed.p > _LEAST)):
        change = weighed.candidates.change(int(i))
        if change.kind != "area":
            continue
        row, col, radius = change.where
        mask = Mask(row, col, radius, numbers[change.from_mission])
        if not any(mask.first <= other.first and _overlap(mask, other) for other in masks):
            found.append((weighed.p[i], mask))
            p += weighed.p[i]
    return max(found)[1] if p > _PROBABLE else None


def resolved(changes: str, model: TrustModel, *, all_alike: bool) -> str:
    """Resolve the treatment of changes of places: `"ignore"`, `"mask"` or `"reset"`.

    Args:
        changes: Option of the campaign; `"auto"` masks what has effects of places.
        model: Model of the campaign.
        all_alike: Whether its posteriors are of all missions, with equal weights.

    Raises:
        TrustboError: Changes cannot be weighed under the model, and are to be.
    """
    reason = why_no_changes(model)
    if changes == "auto":
        return "mask" if not reason and all_alike and model.place is not None else "ignore"
    if changes != "ignore" and reason:
        raise TrustboError(f'{reason} Give changes="ignore", or another model.')
    return changes


def _overlap(one: Mask, other: Mask) -> bool:
    distance = np.hypot(one.row - other.row, one.col - other.col)
    return bool(distance <= one.radius + other.radius)
