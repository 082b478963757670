"""NumPyro's NUTS for the program of a model, in which trust is integrated out."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from numpyro.infer import MCMC, NUTS

from trustbo import Mission
from trustbo.models.model import TrustModel

WARMUP, DRAWS, CHAINS = 500, 1000, 4
"""Lengths of all peers' runs."""


def nuts(program: Callable[..., None], *data: Any) -> Callable[[int], tuple[dict, int]]:
    """Make a sampler of a program, called with `data`, that is compiled.

    Call this function and the sampler within one `own_settings()`; NumPyro fails to run a second
    time after the settings were left and entered again.
    """
    mcmc = MCMC(
        NUTS(program), num_warmup=WARMUP, num_samples=DRAWS, num_chains=CHAINS,
        chain_method="vectorized", progress_bar=False,
    )  # fmt: skip

    def sample(seed: int) -> tuple[dict, int]:
        mcmc.run(jax.random.key(seed), *data)
        draws = {n: np.asarray(v) for n, v in mcmc.get_samples(group_by_chain=True).items()}
        return draws, int(mcmc.get_extra_fields()["diverging"].sum())

    sample(10_000)
    return sample


def samplers(
    model: TrustModel, missions: Sequence[Mission]
) -> dict[str, Callable[[int], tuple[dict, int]]]:
    """The sampler, by name, of the program of one of our models."""
    return {"NumPyro's NUTS, model.program": nuts(model.program, model.observations(missions))}
