"""The fit of a posterior anew: its missions as a batch, and its model at their resolution."""

import json
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.inference.posterior_tree import missions_of
from trustbo.models.effects.effect import Slots
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.model import TrustModel
from trustbo.models.place import places_of
from trustbo.models.record import model_from_record
from trustbo.models.ticks import weigh_ticks
from trustbo.stacking import MissionBatch, stack_missions
from trustbo.workspace import Workspace


class FitData(NamedTuple):
    """Model and data of a fit."""

    model: TrustModel
    missions: list[Mission]
    batch: MissionBatch
    weight: np.ndarray  # (mission,), padding included

    @classmethod
    def of(
        cls,
        posterior: xr.DataTree,
        missions: Sequence[Mission] | None,
        workspace: Workspace | None,
        model: TrustModel | None,
    ) -> "FitData":
        """Fit of a posterior, its missions being given or in it.

        TrustboError: it holds no missions and none are given, or custom priors and no model.
        """
        missions = missions_of(posterior) if missions is None else list(missions)
        missions = missions if workspace is None else [workspace.fill(m) for m in missions]
        features, attrs = missions[0].features, posterior.attrs
        if model is None:
            model = model_from_record(json.loads(attrs["model_record"]), features=features)
        batch = stack_missions(missions)
        weight = np.ones(len(batch.contact_rate))
        weight[: len(missions)] = np.atleast_1d(attrs.get("weights", 1.0))
        model = model.for_features(features)
        return cls(model.at_resolution(weigh_ticks(batch, weight)), missions, batch, weight)

    def slots(self, place: PlaceEffect | None, workspace: Workspace | None = None) -> Slots:
        """Rates by chain, with the places that a model with effects of `place` has."""
        places = places_of(self.missions, place, self.batch.contact_rate.shape, workspace)
        features = self.missions[0].features
        return Slots.of(self.batch, len(self.missions), features, self.weight, places)
