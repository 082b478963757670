"""Real processes, killed: the next one has the same state."""

import json
import random
import signal
import subprocess
import sys
import time
import urllib.request

import pytest


class Process:
    """`trustbo live` in a process of its own."""

    def __init__(self, folder):
        command = [sys.executable, "-m", "trustbo", "live", str(folder), "--port", "0"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE)
        first = self.process.stdout.readline().decode()
        self.url, _, self.token = first.split()[1].partition("#token=")

    def call(self, path, data=None):
        head = {"Authorization": f"Bearer {self.token}"}
        request = urllib.request.Request(self.url + path, data, head)
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)

    def settled(self):
        """State once nothing is learned or planned, without what a process counts anew."""
        while (state := self.call("api/state"))["phase"] in ("learning", "planning"):
            time.sleep(0.05)
        anew = ("version", "log", "idle", "poses", "taken", "refused", "lost", "last_refusal")
        return {name: value for name, value in state.items() if name not in anew}

    def end(self, number):
        self.process.send_signal(number)
        self.process.wait()
        self.process.stdout.close()


@pytest.mark.slow  # processes start for long
def test_killed_at_ten_moments_it_comes_back_with_the_same_state(folder):
    rng, process, seen = random.Random(1), Process(folder), set()
    for _ in range(10):
        for _ in range(rng.randrange(3, 25)):
            state = process.settled()
            k, ticks = state["bound"], state["robots"][0].get("n_ticks", 0)
            if state["phase"] == "ready":
                message = {"bound": k}
            elif ticks < 5:
                message = {"contact": [rng.random() < 0.8 for _ in range(3)]}
            else:
                message = {"status": "ok"}
            process.call("api/messages", json.dumps(message).encode())
        busy = process.call("api/state")["phase"] in ("learning", "planning")
        before = None if busy else process.settled()
        process.end(signal.SIGKILL)
        process = Process(folder)
        if before is not None:
            assert process.settled() == before
            seen.add((before["phase"], before["mission"]))
    assert len(seen) > 2
    process.end(signal.SIGTERM)
    assert process.process.returncode == 0
