"""Live campaigns: time of an update, ticks lost, memory, and what a kill leaves.

`ticks` replays an hour of 30 robots at 10 Hz, a message a tick, as fast as it is taken, and reads
the trust after each; `robots` six minutes of it, a message of each robot. `process` replays the
hour through the pipe of a process that also answers over HTTP, at 20 times its pace. `kill` ends a
process by SIGKILL at ten moments of a mission, and measures until its state is read again over
HTTP, the imports of Python apart. Its processes keep the bytecode of modules, as an installed
Python does, also where `PYTHONDONTWRITEBYTECODE` is set.
"""

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

import numpy as np
from common import Table, arguments, parsed, verdict

import trustbo as tb
from trustbo.live import Live

N_ROBOTS, RATE, N_BOUNDS = 30, 10, 12
TRUTH = tb.models.TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)


def campaign_of(folder: Path, n_robots: int = N_ROBOTS, n_missions: int = 2) -> Path:
    """Folder of a campaign that has learned from some missions."""
    maps = np.random.default_rng(0).uniform(size=(n_robots, 10, 10, 2))
    workspace = tb.Workspace.from_awareness(maps)
    with tb.Campaign(workspace, (9, 0), (0, 9), sampler="exact", directory=folder) as campaign:
        for _ in campaign.run(tb.simulation.ModelSimulator(workspace, TRUTH), n_missions):
            pass
    return folder


def messages(n_ticks: int, path, *, apart: bool = False):
    """Lines of the first bounds of a mission, as many ticks in each."""
    rng, names = np.random.default_rng(1), [f"r{i + 1}" for i in range(N_ROBOTS)]
    n_bounds = min(N_BOUNDS, len(path) - 1) - 1  # the mission is not over: no fit
    for k in range(1, n_bounds + 1):
        yield {"bound": k}
        for i in range(n_ticks // n_bounds + (k <= n_ticks % n_bounds)):
            seen = (rng.uniform(size=N_ROBOTS) < 0.8).tolist()
            if apart:
                yield from (
                    {"contact": {name: flag}} for name, flag in zip(names, seen, strict=True)
                )
            else:
                yield {"contact": dict(zip(names, seen, strict=True)), "t": i / RATE}
        if k < n_bounds:
            yield {"status": "ok"}


def memory() -> float:
    """MB that the process holds now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def update_times(folder: Path, n_ticks: int, *, apart: bool) -> None:
    held = []
    with Live(folder, replan=False) as live:
        lines = [json.dumps(m).encode() for m in messages(n_ticks, live.mission.path, apart=apart)]
        taken, seconds, processor = np.zeros((3, len(lines)))
        started = time.perf_counter()
        for i, line in enumerate(lines):
            if i % (len(lines) // 4) == 0:
                held.append(memory())
            begun, busy = time.perf_counter(), time.thread_time()
            message = live.reader.read(line)
            while not live.take(message):
                live.settle()
            taken[i] = time.perf_counter() - begun
            assert live.follower.now is not None  # the trust of every robot with all ticks
            seconds[i] = time.perf_counter() - begun
            processor[i] = time.thread_time() - busy
            if i % 1000 == 0:
                live.journal.sync()
        total = time.perf_counter() - started
        mission = live.mission
        counted = sum(int(run.n_ticks.sum()) for run in (*mission.bounds, mission.running))
    held.append(memory())
    with Live(folder) as again:  # what the journal holds
        kept = sum(int(r.n_ticks.sum()) for r in (*again.mission.bounds, again.mission.running))
    print(f"{len(lines)} messages in {total:.1f} s, {len(lines) / total:.0f} a second")
    lost = N_ROBOTS * n_ticks - counted, N_ROBOTS * n_ticks - kept
    table = Table("", "value", "target", "met", first=36)
    for what, times in (("update", taken), ("update and trust", seconds)):
        p50, p99, most = np.percentile(1e3 * times, [50, 99, 100])
        table.row(f"{what}, median (ms)", f"{p50:.3f}", "", "")
        table.row(f"{what}, 99 % (ms)", f"{p99:.3f}", "5", verdict(p99 <= 5.0))
        table.row(f"{what}, longest (ms)", f"{most:.1f}", "", "")
    p99 = np.percentile(1e3 * processor, 99)
    table.row("the same, of the processor (ms)", f"{p99:.3f}", "", "")
    table.row("looks lost, and lost after a restart", lost, "0", verdict(lost == (0, 0)))
    growth = held[-1] - held[1]  # the first quarter fills caches
    table.row("memory by quarter (MB)", " ".join(f"{m:.0f}" for m in held), "flat",
              verdict(growth < 10.0))  # fmt: skip


class Process:
    """`trustbo live` in a process of its own."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.started = time.perf_counter()
        command = [
            sys.executable,
            "-X",
            "importtime",
            "-m",
            "trustbo",
            "live",
            str(folder),
            "--port",
            "0",
        ]
        kept = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(folder.parent / "pyc")}
        self._errors = tempfile.TemporaryFile()
        self.process = subprocess.Popen(
            [*command, *options], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=self._errors, env=os.environ | kept,
        )  # fmt: skip
        first = self.process.stdout.readline().decode()
        self.seconds, self.busy = time.perf_counter() - self.started, self._processor()
        self.url, _, self.token = first.split()[1].partition("#token=")

    def _processor(self) -> float:
        """Seconds that it has had the processor."""
        ticks = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")

    def imports(self) -> float:
        """Seconds of imports."""
        self._errors.seek(0)
        rows = [line.split(b"|") for line in self._errors.read().splitlines() if b"|" in line]
        return (
            sum(
                int(row[0].split(b":")[1])
                for row in rows[1:]
                if row[0].split(b":")[1].strip().isdigit()
            )
            / 1e6
        )

    def state(self) -> dict:
        """State over HTTP."""
        request = urllib.request.Request(
            self.url + "api/state", headers={"Authorization": f"Bearer {self.token}"}
        )
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)

    def tell(self, line: bytes) -> None:
        """Tell it a line."""
        request = urllib.request.Request(
            self.url + "api/messages", line, {"Authorization": f"Bearer {self.token}"}
        )
        urllib.request.urlopen(request, timeout=60).close()

    def end(self, number: int = signal.SIGTERM) -> None:
        """End it by a signal."""
        self.process.send_signal(number)
        self.process.wait()
        self.process.stdout.close()


def memory_of(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def through_a_process(folder: Path, n_ticks: int, pace: float) -> None:
    process = Process(folder, "--stdin", "--keep-path")
    path = process.state()["path"]
    held, seconds = [], []
    lines = [json.dumps(m).encode() + b"\n" for m in messages(n_ticks, path)]
    started = time.perf_counter()
    for i, line in enumerate(lines):
        if i % (len(lines) // 4) == 0:
            held.append(memory_of(process.process.pid))
        if i % 500 == 0:  # a page that asks meanwhile
            begun = time.perf_counter()
            process.state()
            seconds.append(time.perf_counter() - begun)
        time.sleep(max(0.0, started + i / RATE / pace - time.perf_counter()))
        process.process.stdin.write(line)
        process.process.stdin.flush()
    while process.state()["taken"] < len(lines):
        time.sleep(0.1)
    total = time.perf_counter() - started
    held.append(memory_of(process.process.pid))
    process.end(signal.SIGKILL)
    process.process.stdin.close()
    with Live(folder) as again:
        kept = sum(int(r.n_ticks.sum()) for r in (*again.mission.bounds, again.mission.running))
    lost = N_ROBOTS * n_ticks - kept
    table = Table("", "value", "target", "met", first=36)
    table.row("seconds of an hour", f"{total:.0f}", "", "")
    table.row("looks lost, after SIGKILL", lost, "0", verdict(lost == 0))
    growth = held[-1] - held[1]
    table.row("memory by quarter (MB)", " ".join(f"{m:.0f}" for m in held), "flat",
              verdict(growth < 10.0))  # fmt: skip
    table.row("state over HTTP, longest (ms)", f"{1e3 * max(seconds):.0f}", "", "")


def shown(state: dict) -> dict:
    """State without what a fresh process counts anew."""
    anew = ("version", "log", "idle", "poses", "taken", "refused", "lost", "last_refusal")
    return {name: value for name, value in state.items() if name not in anew}


def kills(folder: Path, n: int) -> None:
    rng, table = (
        random.Random(0),
        Table("killed after", "same", "s to answer", "of these imports", "rest", "s of processor"),
    )
    rests = []
    for _ in range(n):
        process = Process(folder)
        state = process.state()
        for _ in range(rng.randrange(1, 30)):
            if (state := process.state())["phase"] == "running":
                ticks = [{"contact": [rng.random() < 0.8 for _ in range(3)]} for _ in range(8)]
                lines = [*ticks[: rng.randrange(8)], {"status": "ok"}]
            else:
                lines = [{"bound": state["bound"]}, {"contact": [1, 1, 0]}]
            process.tell("\n".join(map(json.dumps, lines)).encode())
            state = process.state()
            if state["phase"] == "learning" and rng.random() < 0.7:
                break  # in the middle of a fit
            while process.state()["phase"] == "learning":
                time.sleep(0.02)
        before = process.state()
        process.end(signal.SIGKILL)
        again = Process(folder)
        while (after := again.state())["phase"] in ("learning", "planning"):
            time.sleep(0.02)
        busy = before["phase"] in ("learning", "planning")  # it does then what was to be done
        same = after["mission"] >= before["mission"] if busy else shown(after) == shown(before)
        imports = again.imports()
        rests.append(again.seconds - imports)
        moment = f"mission {before['mission']}, bound {before['bound']}, {before['phase']}"
        table.row(
            moment, verdict(same), f"{again.seconds:.1f}", f"{imports:.1f}", f"{rests[-1]:.1f}",
            f"{again.busy:.1f}",
        )  # fmt: skip
        again.end()
    print(f"longest rest {max(rests):.1f} s (target 2: {verdict(max(rests) <= 2.0)})")


def main() -> None:
    parser = arguments(__doc__, quick="two minutes instead of an hour, three kills",
                       names=("ticks", "robots", "process", "kill"))  # fmt: skip
    given = parsed(parser)
    hour = (120 if given.quick else 3600) * RATE
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as name:
        room = Path(name)
        big = campaign_of(room / "big") if set(given.names) - {"kill"} else room
        for part in given.names:
            print(f"\n{part}", flush=True)
            folder = room / part
            if part == "kill":
                campaign_of(folder, 3)
                kills(folder, 3 if given.quick else 10)
                continue
            shutil.copytree(big, folder)
            if part == "process":
                through_a_process(folder, hour, 20.0)
            else:
                update_times(
                    folder, hour // 10 if part == "robots" else hour, apart=part == "robots"
                )


if __name__ == "__main__":
    main()
