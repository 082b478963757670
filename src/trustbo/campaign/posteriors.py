"""Posteriors of a campaign, in memory or in files until they are asked for."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.inference import complete
from trustbo.inference.posterior_groups import parameters_alone
from trustbo.logs.netcdf import read_tree
from trustbo.models.model import TrustModel


class Posterior:
    """A posterior in memory, or in a file until it is asked for.

    Attributes:
        name: Name of its file: the number of missions recorded when it was fitted, and, where some
            were excluded from it, their number, such as `"0003-1"`.
        file: File that holds it; None where it is in memory only.
    """

    def __init__(
        self, name: str, tree: xr.DataTree | None = None, file: Path | None = None
    ) -> None:
        """Hold a tree, or the name of a file of `logs.netcdf.write_tree`."""
        self.name, self.file, self._tree = name, file, tree

    def __call__(self) -> xr.DataTree:
        """Posterior as stored: parameters alone, unless its trust was sampled too.

        DamagedFileError: its file is missing or damaged.
        """
        if self._tree is None:
            self._tree = read_tree(self.file or "")
        return self._tree

    def shrink(self) -> None:
        """Drop all groups except for the parameters; `complete` computes them again."""
        if self._tree is not None and "latent" in self._tree.children:
            self._tree, self.file = parameters_alone(self._tree), None


class Posteriors(Sequence[xr.DataTree]):
    """Posterior after each recorded mission; None where nothing could be learned yet."""

    def __init__(self, stored: Iterable[Posterior | None]) -> None:
        """Take posteriors as stored."""
        self.stored = list(stored)

    @classmethod
    def from_trees(cls, posteriors: Sequence[xr.DataTree | None]) -> "Posteriors":
        """Posteriors of a result, whose trees may be in a plain list."""
        if isinstance(posteriors, Posteriors):
            return posteriors
        numbered = enumerate(posteriors, start=1)
        return cls(None if tree is None else Posterior(f"{j:04d}", tree) for j, tree in numbered)

    @property
    def names(self) -> list[str | None]:
        """Name of the posterior after each mission."""
        return [posterior and posterior.name for posterior in self.stored]

    def __len__(self) -> int:
        return len(self.stored)

    def __iter__(self) -> Iterator[xr.DataTree]:
        return (self[j] for j in range(len(self)))

    def __getitem__(self, j: Any) -> Any:
        if isinstance(j, slice):
            return Posteriors(self.stored[j])
        posterior = self.stored[j]
        return None if posterior is None else posterior()


def whole_posterior(
    stored: xr.DataTree, missions: Sequence[Mission], model: TrustModel | None = None
) -> xr.DataTree:
    """Posterior with all groups, its missions labelled by their numbers in the campaign, from 0.

    `missions` are all recorded so far. The model, for `log_prior`, is needed where its priors are
    not the default.
    """
    numbers = np.atleast_1d(stored.attrs["missions"]).astype(int).tolist()
    whole = complete(stored, [missions[j] for j in numbers], model=model)
    groups = {name: group.to_dataset() for name, group in whole.children.items()}
    for name, group in groups.items():
        if "mission" in group.dims:
            groups[name] = group.assign_coords(mission=numbers)
    labelled = xr.DataTree.from_dict(groups)
    labelled.attrs = whole.attrs
    return labelled
