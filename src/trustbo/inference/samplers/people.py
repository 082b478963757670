"""The posterior of people's trust: scores of cut points join those of memory and spreads."""

from typing import Any

import numpy as np

from trustbo.inference.evidence.blocks import Blocks
from trustbo.inference.samplers.posterior import Posterior
from trustbo.inference.samplers.scores import Scores
from trustbo.models.effects.effect import Slots
from trustbo.models.people import HumanTrust


class PeopleScores(Scores):
    """Scores of `Scores`, and those of free cut points, which are standard normal themselves."""

    def __init__(self, model: HumanTrust, *, carries: bool = True) -> None:
        """Take the priors and effects of a model; `carries` as in `Scores`."""
        super().__init__(model.priors, model.effects, model.memory, carries=carries)
        self.cuts = model.levels.names
        self.n_scores += len(self.cuts)

    def with_core(self, core: Any, z: Any) -> dict[str, Any]:
        """See `Scores.with_core`."""
        first = self.n_scores - len(self.cuts)
        cuts = {name: z[:, first + j] for j, name in enumerate(self.cuts)}
        return super().with_core(core, z) | cuts


class PeoplePosterior(Posterior):
    """Posterior of scores under blocks of persons, whose points are cheap to draw at."""

    def __init__(self, model: HumanTrust, slots: Slots, *, carries: bool = True) -> None:
        """Lay out the reports of missions; `carries` as in `Scores`."""
        evidence = evidence_of(model, slots)
        super().__init__(PeopleScores(model, carries=carries), evidence, float(np.nanstd(slots.y)))
        if not evidence.exact:
            self.n_corrected = 1000


def evidence_of(model: HumanTrust, slots: Slots, asked: np.ndarray | None = None) -> Blocks:
    """Evidence of a model; see `Blocks` for the bounds that are `asked` about."""
    x0 = float(model.priors.x0_mean), float(model.priors.x0_sd)
    return Blocks(
        slots, model.shared(slots), model.effect.group(slots), model.levels, x0, model.lasting,
        asked=asked,
    )  # fmt: skip
