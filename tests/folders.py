"""Campaigns in folders: a small one with every kind of event, and all numbers of a result."""

import numpy as np
from worlds import ModelSimulator

import trustbo as tb

ENDS = ((2, 0), (0, 2))
OPTIONS = {"policy": "thompson", "sampler": "importance", "seed": 3, "fit": {"draws": 50}}


def numbers(result):
    """All numbers of a result by name."""
    found = {
        "path": np.array(result.path),
        "trust": result.plan().trust,
        "map": result.trust_map.values,
    }
    for name, column in result.history.data_vars.items():
        found[name] = column.values
    for j, tree in enumerate(result.posteriors):
        for group in {"posterior", "places", "robots", "hazard"} & {
            *(tree.children if tree else ())
        }:
            for name, values in tree[group].data_vars.items():
                found[f"{group} {name} after {j + 1}"] = values.values
    for j, mission in enumerate(result.missions):
        found[f"awareness of {j + 1}"] = mission.awareness
        found[f"rates of {j + 1}"] = mission.contact_rate
    return found | {"failures": np.array([str(f) for f in result.state.failures])}


def same(one, other):
    """Assert that two results have equal numbers; the other may be given by its `numbers`."""
    one, other = numbers(one), other if isinstance(other, dict) else numbers(other)
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)


def drive(campaign):
    """Run a campaign of four missions, of which one fails, one is given up, one is excluded."""
    simulator = ModelSimulator(campaign.workspace, blind=True)

    def run():
        seed = campaign.state.seed_of("mission")
        campaign.tell(simulator.run(campaign.ask().path, seed=seed))

    if not campaign.missions:
        run()
    if len(campaign.missions) == 1 and not campaign.state.failures:
        campaign.ask()
        campaign.fail("stuck", where=campaign.ask().path[1])
    for n in (1, 2, 3):
        if len(campaign.missions) == n:
            simulator.fail_at = 1 if n == 2 else None
            run()
        if n == 2 and len(campaign.missions) == 3 and len(campaign.state.used) == 3:
            campaign.exclude(1, "the lidar was covered")
    return campaign


def begin(workspace, folder, **options):
    """Begin a campaign in a folder."""
    return tb.Campaign(workspace, *ENDS, directory=folder, **OPTIONS | options)
