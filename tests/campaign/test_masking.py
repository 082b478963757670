"""Masks of areas that have changed: what they leave out, what they bring, what keeps them."""

import numpy as np
import pytest

import trustbo as tb
from trustbo.campaign.masking import Mask, masked, masks_of
from trustbo.models import PlaceEffect, PooledTrust

FROM = 5  # the first mission with the jam, from 0
JAM = {(2, 2), (2, 3), (3, 2)}
SIGHT = np.random.default_rng(0).uniform(0.6, 0.9, (3, 5, 5, 1))
FEATURES = ["line_of_sight"]
MODEL = PooledTrust(place=PlaceEffect())


def workspace_of():
    return tb.Workspace.from_awareness(SIGHT, np.ones((5, 5), bool), features=FEATURES)


def mission_on(path, number, rng):
    """Mission whose robots see half as much, less .4, where there is a jam."""
    rows, cols = np.array(path)[1:].T
    z = np.swapaxes(SIGHT[:, rows, cols], 0, 1)
    jam = np.array([number >= FROM and cell in JAM for cell in path[1:]])
    rates = z[..., 0] - 0.5 * jam[:, None] + 0.03 * rng.standard_normal(z.shape[:2])
    return tb.Mission.from_arrays(path, z, np.clip(rates, 0.01, 0.99), features=FEATURES)


def drive(campaign, numbers):
    """Missions by the campaign's plans, and in turn with them straight through the jam."""
    through = ((4, 0), (3, 1), (2, 2), (1, 3), (0, 4))
    for number in numbers:
        path = through if number % 2 else campaign.ask().path
        mission = mission_on(path, number, np.random.default_rng(number))
        campaign.tell(mission, other_path=path is through)


def begun(**options):
    return tb.Campaign(
        workspace_of(), (4, 0), (0, 4), model=MODEL, seed=1, max_bounds="shortest+2", **options
    )


@pytest.fixture(scope="module")
def jammed():
    campaign = begun()  # the default, with effects of places
    drive(campaign, range(11))
    return campaign


def test_a_mask_leaves_out_rates_in_its_area_before_its_first_mission():
    path = ((4, 0), (3, 1), (2, 2), (1, 3), (0, 4))
    mission = mission_on(path, 0, np.random.default_rng(0))
    before, after = masked([mission, mission], [3, 4], [Mask(2, 2, 1, 4)])
    left_out = np.isnan(before.contact_rate)
    assert left_out[1].all()
    assert not left_out[[0, 2, 3]].any()
    assert after is mission
    kept = ~left_out
    np.testing.assert_array_equal(before.contact_rate[kept], mission.contact_rate[kept])
    everywhere = [Mask(2, 2, 50, 4)]  # nothing would be left of the mission
    assert masked([mission], [3], everywhere) == [mission]


def test_an_area_that_changed_is_masked_from_the_mission_of_the_change(jammed):
    masks = masks_of(jammed.posteriors[-1])
    assert masks
    assert all(abs(mask.first - FROM) <= 1 for mask in masks)  # a day may pass for it
    held = {cell for cell in np.ndindex(5, 5) for mask in masks if mask.holds(np.array(cell))}
    assert (2, 2) in held
    assert masks_of(jammed.posteriors[FROM - 1]) == []
    numbers = jammed.history["n_masks"].values
    assert numbers[FROM - 1] == 0
    assert numbers[-1] == len(masks)


def test_rates_left_out_are_missing_from_the_posterior_and_kept_in_the_missions(jammed):
    observed = jammed.posterior["observed_data"]["contact_rate"]
    assert np.isnan(observed.sel(mission=1)).any()
    assert not any(np.isnan(mission.contact_rate).any() for mission in jammed.missions)


def test_what_is_in_the_area_now_is_learned_sooner_with_the_mask(jammed):
    ignored = begun(changes="ignore")
    drive(ignored, range(11))
    assert masks_of(ignored.posteriors[-1]) == []
    now = float(SIGHT[:, 2, 2, 0].mean()) - 0.5
    errors = [abs(float(c.trust_map()[2, 2]) - now) for c in (jammed, ignored)]
    assert errors[0] < 0.7 * errors[1]


def test_masks_stay_after_a_campaign_is_saved_and_read_again(jammed, tmp_path):
    jammed.save(tmp_path / "run")
    again = tb.Campaign.load(tmp_path / "run")
    before = masks_of(jammed.posteriors[-1])
    assert masks_of(again.posteriors[-1]) == before
    drive(again, [11])
    assert masks_of(again.posteriors[-1])[: len(before)] == before


def test_what_has_no_effects_of_places_or_forgets_is_not_masked_by_default():
    place = PlaceEffect()
    censored, odd = (PooledTrust(place=place, observation=o) for o in ("censored", "student_t"))
    for model, changes in (
        (None, "mask"), (PooledTrust(), "ignore"), (censored, "mask"), (odd, "ignore"),
    ):  # fmt: skip
        campaign = tb.Campaign(workspace_of(), (4, 0), (0, 4), model=model)
        assert campaign.learner.changes == changes
    assert begun(forgetting=0.9).learner.changes == "ignore"


@pytest.mark.parametrize(
    ("model", "named"),
    [
        (PooledTrust(observation="student_t"), "student_t"),
        (PooledTrust(response="change"), "change"),
        (tb.models.HierarchicalTrust(), "HierarchicalTrust"),
    ],
)
def test_models_under_which_changes_are_not_weighed_are_refused(model, named):
    with pytest.raises(tb.TrustboError, match=f'changes are weighed .*{named}.*changes="ignore"'):
        tb.Campaign(workspace_of(), (4, 0), (0, 4), model=model, changes="mask")
