"""Seeded campaigns take the paths that they took before, and learn the same."""

import json

import numpy as np
import pytest
from golden import EXACT, STORED, campaign

KEPT = json.loads(STORED.read_text(encoding="utf-8"))
ROUNDING = 1e-6
SHARE = 0.3
"""Largest difference of a posterior mean, in its Monte Carlo standard errors.

Another processor's linear algebra rounds otherwise by 1e-16, so that the adaptive sampler may
resample another draw of 4000: that moves means by .11 standard errors at most. Another stream of
random numbers moves them by a median of .4 to 1.6.
"""


@pytest.mark.parametrize("name", KEPT)
@pytest.mark.filterwarnings("ignore::UserWarning")  # of what is not recommended
def test_seeded_campaign_takes_the_paths_and_learns_the_means_kept(name):
    kept = KEPT[name]
    found = campaign(EXACT[name], sampler="importance", n_iterations=3)
    same = [a == b for a, b in zip(found["path"], kept["path"], strict=True)]
    if not all(same):
        # Of two paths that tie, rounding chooses; what is learned from another path is other.
        n = same.index(False) + 1
        np.testing.assert_allclose(found["objective"][:n], kept["objective"][:n], rtol=ROUNDING)
        return
    if found["recommended"] != kept["recommended"]:
        np.testing.assert_allclose(found["value"], kept["value"], rtol=ROUNDING)
    np.testing.assert_allclose(found["contact_rate"], kept["contact_rate"], rtol=ROUNDING)
    for quantity, se in kept.items():
        if quantity.endswith(" se"):
            mean = quantity.removesuffix(" se")
            assert abs(found[mean] - kept[mean]) <= SHARE * se, mean
