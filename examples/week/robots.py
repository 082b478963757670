"""Simulated robots that drive the next mission of a campaign, and write the log of a team.

    python robots.py FOLDER LOG [--day DATE] [--detections FILE] [--stuck BOUND] [--way K]

It stands for the drives of `week.sh`: a real team writes such tables itself. Contact is in percent,
positions in metres, and dates in local time. Bravo's lidar detects the lead in 60 % of its scans.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

import trustbo as tb

ZONE = "America/Los_Angeles"
NOISE = 0.3
"""Standard deviation of logged positions, m."""
WITHSTOOD = np.radians(40.0)
"""Slope that the robots withstand."""
TICK = 0.5


def drive(folder, seed, way):
    """Mission that the robots drive, and the workspace; it may lead along another way."""
    with tb.Campaign.load(folder) as campaign:
        plan = campaign.state.asked
        if plan is None:
            raise SystemExit("no mission is asked for; call trustbo ask")
        if way is not None:
            plan = campaign.ways(plan.start, plan.goal)[way]

    whole = plan.workspace.whole
    robots = [replace(robot, max_slope=WITHSTOOD) for robot in whole.team.robots]
    robots[1] = replace(robots[1], detection=0.6)
    lead = replace(whole.team.lead, max_slope=WITHSTOOD)
    team = replace(whole.team, robots=tuple(robots), lead=lead)
    simulator = tb.simulation.KinematicSimulator(whole, team=team, tick=TICK)
    mission = simulator.run(plan.path, post_sets=plan.post_sets, seed=seed)
    return mission.of_robots(plan.robots), whole


def legs_of(mission, workspace, day, n_bounds, rng):
    """Table with a row for each leg and vehicle; the last leg may be the one that got stuck."""
    rows = []
    start = pd.Timestamp(f"{day} 09:30:00")
    for k, bound in enumerate(mission.bounds[:n_bounds], start=1):
        x, y = workspace.posts.stop(bound.cell) + rng.normal(0.0, NOISE, 2)
        begin, end = (start + pd.Timedelta(seconds=t) for t in (bound.t0, bound.t1))
        is_stuck = k == n_bounds
        for name, rate in zip(mission.robots, bound.contact_rate, strict=True):
            rows.append(
                {
                    "run": day,
                    "leg": k,
                    "vehicle": name,
                    "utm_e": round(x, 2),
                    "utm_n": round(y, 2),
                    "contact_pct": round(100.0 * rate, 1),
                    "leg_start": begin.isoformat(),
                    "leg_end": end.isoformat(),
                    "outcome": "STUCK" if is_stuck else bound.status.upper(),
                    "note": "dust" if k == 1 else "",
                }
            )
    return pd.DataFrame(rows)


def tracks_of(mission, day, rng):
    """Tables of poses and of detections, at each tick."""
    start = pd.Timestamp(f"{day} 09:30:00")
    names = ("lead", *mission.robots)
    poses, detections = [], []
    for bound in mission.bounds:
        for k, (places, seen) in enumerate(zip(bound.poses, bound.contact, strict=True)):
            stamp = (start + pd.Timedelta(seconds=bound.t0 + (k + 0.5) * TICK)).isoformat()
            found = [places[i, :2] + rng.normal(0.0, NOISE, 2) for i in range(len(names))]
            poses += [
                {"stamp": stamp, "vehicle": name, "utm_e": x, "utm_n": y}
                for name, (x, y) in zip(names, np.round(found, 2), strict=True)
            ]
            detections += [
                {"stamp": stamp, "by": name, "of": "lead"}
                for name, is_seen in zip(names[1:], seen, strict=True)
                if is_seen
            ]
    return pd.DataFrame(poses), pd.DataFrame(detections)


def corrected(file):
    """Table of an earlier log in which bravo had contact for ten percent less of each leg."""
    legs = pd.read_csv(file)
    of_bravo = legs["vehicle"] == "bravo"
    legs.loc[of_bravo, "contact_pct"] = (0.9 * legs.loc[of_bravo, "contact_pct"]).round(1)
    return legs


def main(words=None):
    """Write the log of a mission."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("log", type=Path)
    parser.add_argument("--day", default="2026-05-04")
    parser.add_argument("--detections", type=Path)
    parser.add_argument("--stuck", type=int)
    parser.add_argument("--way", type=int)
    parser.add_argument("--again", type=Path)
    args = parser.parse_args(words)
    if args.again is not None:
        corrected(args.again).to_csv(args.log, index=False)
        return

    seed = int(args.log.stem.split("-")[-1])
    rng = np.random.default_rng(seed)
    mission, workspace = drive(args.folder, seed, args.way)
    if args.detections is not None:
        poses, detections = tracks_of(mission, args.day, rng)
        poses.to_csv(args.log, index=False)
        detections.to_csv(args.detections, index=False)
    else:
        legs = legs_of(mission, workspace, args.day, args.stuck, rng)
        legs.to_csv(args.log, index=False)


if __name__ == "__main__":
    main()
