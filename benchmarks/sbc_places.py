"""Simulation-based calibration of effects of places: walks, and the effects that are ranked."""

from typing import NamedTuple, Self, cast

import numpy as np
from jax import random

from trustbo.inference.place_maps import draw_maps, nowhere, scales_of
from trustbo.inference.prior_predictive import draw_sites
from trustbo.inference.samplers.run import Draws
from trustbo.inference.sbc import with_effects_drawn
from trustbo.models.backend import own_settings
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.model import TrustModel
from trustbo.models.place import Visited, visited
from trustbo.stacking import MissionBatch
from trustbo.workspace.moves import MOVES

_SHAPE = (4, 4)


class Walks(NamedTuple):
    """Random walks over a small grid."""

    bounds: np.ndarray  # (mission, bound, 3): move, row, col

    @classmethod
    def random(cls, shape: tuple[int, int], seed: int) -> Self:
        """Walks of so many missions and bounds, each from the corner at (0, 0)."""
        rng = np.random.default_rng([seed, 7])
        bounds = np.empty((*shape, 3), dtype=int)
        for mission in bounds:
            cell = np.zeros(2, dtype=int)
            for bound in mission:
                while True:
                    move = int(rng.integers(len(MOVES[8])))
                    other = cell + MOVES[8][move]
                    if ((other >= 0) & (other < _SHAPE)).all():
                        break
                cell = other
                bound[:] = move, *cell
        return cls(bounds)

    def places(self, model: TrustModel, n_robots: int = 1) -> Visited:
        """Places that they visit."""
        return visited(self.bounds, cast(PlaceEffect, model.place), n_robots, _SHAPE)

    def simulate(
        self, model: TrustModel, awareness: np.ndarray, ticks: np.ndarray, seed: int
    ) -> dict[str, np.ndarray]:
        """Parameters, ranked effects and contact rates drawn from the prior, by name."""
        place = cast(PlaceEffect, model.place)
        sites = draw_sites(model, awareness.shape[2:], 1, seed)
        empty = nowhere(_SHAPE, self.places(model, awareness.shape[2]).n_effects)
        no = np.zeros((1, 0))
        known = (no if place.cells else None, no if place.bounds else None)
        maps = draw_maps(scales_of(sites), empty, known[0], known[1], seed + 1)
        params = model.params(sites, awareness.shape[3]).draw(0)
        params = params._replace(  # pyright: ignore
            **{n: m if m is None else m[0] for n, m in zip(_EFFECTS, maps, strict=True)}
        )
        batch = MissionBatch(awareness, np.zeros(ticks.shape), ticks)
        on_walks, ranked = with_effects_drawn(model, sites, params.on(self.bounds), batch, seed)
        with own_settings():
            key = random.key(seed)
        sample = model.simulate(key, on_walks, awareness, ticks)
        values = {name: value[0] for name, value in sites.items()} | ranked
        return values | self._ranked(*maps, ()) | {"contact_rate": sample.contact_rate}

    def effects(self, model: TrustModel, draws: Draws, seed: int) -> dict[str, np.ndarray]:
        """Draws of the ranked effects, (chain, draw)."""
        places = self.places(model, 1)
        flat = {name: value.reshape(-1, *value.shape[2:]) for name, value in draws.params.items()}
        known = [
            None if name not in draws.places else draws.places[name].reshape(len(flat["beta0"]), -1)
            for name in _EFFECTS
        ]
        maps = draw_maps(scales_of(flat), places, known[0], known[1], seed)
        return self._ranked(*maps, draws.params["beta0"].shape[:2])

    def _ranked(
        self, place: np.ndarray | None, place_bound: np.ndarray | None, draws: tuple[int, ...]
    ) -> dict[str, np.ndarray]:
        results: dict[str, np.ndarray] = {}
        if place is not None:
            results["place[first]"] = place[:, 0, *self.bounds[0, 0, 1:]]
            results["place[last]"] = place[:, 0, -1, -1]
        if place_bound is not None:
            results["place_bound[first]"] = place_bound[:, 0, *self.bounds[0, 0]]
            results["place_bound[second]"] = place_bound[:, 0, *self.bounds[0, 1]]
        return {name: value.reshape(draws) for name, value in results.items()}


_EFFECTS = ("place", "place_bound")
