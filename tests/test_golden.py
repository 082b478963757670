"""Seeded campaigns give the numbers that they gave before."""

import json

import numpy as np
import pytest
from golden import EXACT, STORED, campaign

KEPT = json.loads(STORED.read_text(encoding="utf-8"))


@pytest.mark.filterwarnings("ignore::UserWarning")  # of what is not recommended
@pytest.mark.parametrize("name", list(KEPT))
def test_a_seeded_campaign_gives_the_numbers_kept(name):
    found = campaign(EXACT[name], sampler="exact", n_iterations=3)
    for quantity, expected in KEPT[name].items():
        if quantity in ("path", "recommended"):
            assert found[quantity] == expected
        else:
            # Not bit by bit: another processor rounds in another way, and a search amplifies it.
            np.testing.assert_allclose(found[quantity], expected, rtol=1e-7, err_msg=quantity)
