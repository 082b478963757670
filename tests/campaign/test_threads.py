"""Campaigns that are used from several threads."""

import asyncio
import threading
import time

import numpy as np
import pytest
from folders import begin, numbers, same
from worlds import ModelSimulator, random_cells

import trustbo as tb

N_THREADS = 4
COURSES = (
    {},
    {"start": (0, 2), "goal": (2, 0), "robots": ("r2",)},
    {"start": (0, 0), "goal": (2, 2)},
)
"""Courses that missions have by turns; the first is the campaign's own."""


@pytest.fixture(scope="module")
def workspace():
    return random_cells(2, 3)


def run_all(work):
    """Call `work(i)` in four threads at once, and raise the errors that they raise."""
    errors = []

    def caught(i):
        try:
            work(i)
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=caught, args=(i,)) for i in range(N_THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


def run_mission(campaign, n):
    """Run the n-th mission, of which the third one is given up."""
    course = COURSES[n % len(COURSES)]
    plan = campaign.ask(**course)
    if n == 2:
        campaign.fail("stuck", where=plan.path[1])
        plan = campaign.ask(**course)
    seed = campaign.state.seed_of("mission")
    mission = ModelSimulator(campaign.workspace, blind=True).run(plan.path, seed=seed)
    campaign.tell(mission.of_robots(plan.robots))


def test_campaign_driven_by_turns_from_four_threads_equals_the_serial_one(workspace, tmp_path):
    n_missions = 5
    with begin(workspace, tmp_path / "serial") as serial:
        for n in range(n_missions):
            run_mission(serial, n)
    turn = threading.Condition()

    with begin(workspace, tmp_path / "threads") as campaign:

        def work(i):
            for n in range(i, n_missions, N_THREADS):
                with turn:
                    turn.wait_for(lambda n=n: len(campaign.missions) == n)
                    run_mission(campaign, n)
                    turn.notify_all()

        run_all(work)
    expected = numbers(serial)
    same(campaign, expected)
    same(tb.load_result(tmp_path / "threads"), expected)


def test_a_thread_that_waits_while_a_campaign_moves_to_a_folder_loses_nothing(workspace, tmp_path):
    """The lock for which the thread waits is the one that the campaign uses afterwards."""
    campaign = begin(workspace, None)
    with campaign._turn:
        waiting = threading.Thread(target=campaign.fail, args=("rain",))
        waiting.start()
        campaign.store_in(tmp_path / "c")

        write, is_writing = campaign.storage.write, []

        def checked(state):
            is_writing.append(None)
            assert len(is_writing) == 1
            time.sleep(0.2)
            write(state)
            is_writing.pop()

        campaign.storage.write = checked
    campaign.fail("snow")
    waiting.join()

    reasons = {failure.reason for failure in campaign.state.failures}
    assert reasons == {"rain", "snow"}
    campaign.close()
    assert len(tb.Campaign.load(tmp_path / "c").state.failures) == 2


def test_missions_told_at_once_are_all_recorded_and_learned(workspace, tmp_path):
    path = ((2, 0), (1, 1), (0, 2))
    told = [ModelSimulator(workspace).run(path, seed=seed) for seed in range(N_THREADS)]
    looks = ((2, 2), (0, 0)), ((0, 0), (2, 0)), ((0, 1), (2, 2)), ((1, 0), (1, 2))
    with begin(workspace, tmp_path) as campaign:
        run_all(lambda i: (campaign.ask(), campaign.tell(told[i]), campaign.plan(*looks[i])))
        found = {mission.contact_rate.tobytes() for mission in campaign.missions}
        assert found == {mission.contact_rate.tobytes() for mission in told}
        assert campaign.posterior["constant_data"].sizes["mission"] == N_THREADS
        with begin(workspace, tmp_path / "serial") as serial:
            for mission in campaign.missions:
                serial.ask()
                serial.tell(mission)
        np.testing.assert_array_equal(
            campaign.posterior["posterior"]["b"], serial.posterior["posterior"]["b"]
        )
    same(tb.load_result(tmp_path), campaign)


def test_tell_in_a_thread_does_not_block_an_event_loop(workspace, tmp_path):
    async def main(campaign, mission):
        ticks = 0
        task = asyncio.create_task(asyncio.to_thread(campaign.tell, mission))
        while not task.done():
            ticks += 1
            await asyncio.sleep(0.001)
        return await task, ticks

    with begin(workspace, tmp_path) as campaign:
        mission = ModelSimulator(workspace).run(campaign.ask().path, seed=0)
        posterior, ticks = asyncio.run(main(campaign, mission))
    assert ticks > 1
    np.testing.assert_array_equal(posterior["posterior"]["b"], campaign.posterior["posterior"]["b"])


def test_campaign_is_closed_from_another_thread(workspace, tmp_path):
    campaign = begin(workspace, tmp_path)
    thread = threading.Thread(target=campaign.close)
    thread.start()
    thread.join()
    with pytest.raises(tb.TrustboError, match="closed"):
        campaign.fail("rain")
    tb.Campaign.load(tmp_path).close()
