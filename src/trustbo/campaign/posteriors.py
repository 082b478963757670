"""Posteriors of a campaign, in memory or in files until they are asked for."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from trustbo.campaign.damage import naming_what_is_left
from trustbo.campaign.migrate import is_whole
from trustbo.data import Mission
from trustbo.errors import DamagedFileError
from trustbo.files import checksum
from trustbo.inference import complete
from trustbo.inference.posterior_groups import parameters_alone
from trustbo.logs.netcdf import read_tree
from trustbo.models.model import TrustModel


class Posterior:
    """A posterior in memory, or in a file until it is asked for.

    Attributes:
        after: Number of missions told when it was fitted; also that of its file.
        file: File that holds it; None where it is in memory only.
    """

    def __init__(
        self, after: int, tree: xr.DataTree | None = None, file: Path | None = None
    ) -> None:
        """Hold a tree, or the name of a file of `logs.netcdf.write_tree`."""
        self.after, self.file, self._tree = after, file, tree
        self._sum = None if file is None else checksum(file)

    def __call__(self) -> xr.DataTree:
        """Posterior as it is kept: parameters alone, unless its trust was sampled too.

        Raises:
            DamagedFileError: Its file is missing, damaged or another's by now.
        """
        if self._tree is None:
            file = Path(self.file or "")
            with naming_what_is_left(file.parent.parent):
                if checksum(file) != self._sum:
                    raise DamagedFileError(f"{str(file)!r} was replaced since it was opened.")
                self._tree = read_tree(file)
        return self._tree

    def shrink(self) -> None:
        """Keep the parameters alone from now on; a later posterior has the rest."""
        if self._tree is not None and "latent" in self._tree.children:
            self._tree, self.file = parameters_alone(self._tree), None


class Posteriors(Sequence[xr.DataTree]):
    """Posterior after each mission told; None where nothing could be learned yet."""

    def __init__(self, kept: Iterable[Posterior | None]) -> None:
        """Take posteriors as they are kept."""
        self.kept = list(kept)

    def __len__(self) -> int:
        return len(self.kept)

    def __iter__(self) -> Iterator[xr.DataTree]:
        return (self[j] for j in range(len(self)))

    def __getitem__(self, j: Any) -> Any:
        if isinstance(j, slice):
            return Posteriors(self.kept[j])
        one = self.kept[j]
        return None if one is None else one()


def whole_posterior(
    kept: xr.DataTree, missions: Sequence[Mission], model: TrustModel | None = None
) -> xr.DataTree:
    """Posterior with all groups, its missions labelled by their numbers in the campaign, from 0.

    Args:
        kept: Posterior as a campaign keeps it.
        missions: All missions told so far, their awareness filled in.
        model: Its model, for `log_prior`; needed where the priors are the user's own.
    """
    if is_whole(kept):
        return kept
    numbers = np.atleast_1d(kept.attrs["missions"]).astype(int)
    whole = complete(kept, [missions[j] for j in numbers], model=model)
    parts = {name: part.to_dataset() for name, part in whole.children.items()}
    for name, part in parts.items():
        if "mission" in part.dims:
            parts[name] = part.assign_coords(mission=numbers)
    labelled = xr.DataTree.from_dict(parts)
    labelled.attrs = whole.attrs
    return labelled


def kept_of(posteriors: Sequence[xr.DataTree | None]) -> list[Posterior | None]:
    """Posteriors as they are kept, one for each mission; trees are numbered in order."""
    if isinstance(posteriors, Posteriors):
        return posteriors.kept
    return [
        None if tree is None else Posterior(j, tree) for j, tree in enumerate(posteriors, start=1)
    ]
