"""Show a mission live in Foxglove: the trust map, the path, and the trust in each robot.

Run `pip install foxglove-sdk`, then `python examples/live_foxglove.py`. In Foxglove, choose "Open
connection", "Foxglove WebSocket", ws://localhost:8765. The script publishes these topics:

    /map    foxglove.Grid         expected trust on arrival at each cell
    /path   foxglove.SceneUpdate  cells that have not been entered yet
    /trust  JSON                  mean and sd of the current trust in each robot, predicted means

The mission is simulated at ten times its speed; for robots, pass their ticks to `Follower.tick`.
"""

import time

import numpy as np

import trustbo as tb


def state_of(follower, robots):
    """Return the current and the predicted trust in each robot, for a JSON message."""
    ahead = follower.ahead().mean.T if len(follower.rest) > 1 else np.empty((len(robots), 0))
    columns = zip(robots, *follower.trust, ahead, strict=True)
    state = {r: {"mean": float(m), "sd": float(s), "ahead": a.tolist()} for r, m, s, a in columns}
    return {"bound": len(follower.bounds) + follower.running, **state}


def grid_of(values, grid):
    """Make the message of a map (row, col); Foxglove expects the southern row first."""
    from foxglove import messages as fg

    data = np.flipud(values).astype("<f4")
    left, bottom = grid.corner
    kind = fg.PackedElementFieldNumericType.Float32
    return fg.Grid(
        frame_id="map", column_count=data.shape[1], cell_stride=4, row_stride=4 * data.shape[1],
        pose=fg.Pose(position=fg.Vector3(x=left, y=bottom), orientation=fg.Quaternion(w=1.0)),
        cell_size=fg.Vector2(x=grid.cell_width, y=grid.cell_height),
        fields=[fg.PackedElementField(name="trust", offset=0, type=kind)], data=data.tobytes(),
    )  # fmt: skip


def path_of(follower, grid):
    """Make the message of the rest of the path, from the current cell of the lead."""
    from foxglove import messages as fg

    line = fg.LinePrimitive(
        type=fg.LinePrimitiveLineType.LineStrip, thickness=4.0, scale_invariant=True,
        points=[fg.Point3(x=x, y=y, z=0.2) for x, y in map(grid.center, follower.rest)],
        color=fg.Color(r=1.0, g=1.0, b=1.0, a=1.0),
    )  # fmt: skip
    return fg.SceneUpdate(entities=[fg.SceneEntity(frame_id="map", id="path", lines=[line])])


def main(faster=10.0):
    """Simulate a mission and publish it."""
    import foxglove

    foxglove.start_server()
    workspace = tb.Workspace.from_terrain(tb.terrain.example(), (10, 10))
    campaign = tb.Campaign(workspace, (9, 0), (0, 9), sampler="importance")
    follower, robots = tb.Follower(campaign), workspace.team.names
    simulator = tb.simulation.KinematicSimulator(workspace)
    driven = simulator.run(follower.path, seed=0, post_sets=follower.post_sets)
    trust_map = campaign.trust_map.values
    for bound in driven.bounds:
        follower.begin(bound.t0)
        times = np.linspace(bound.t0, bound.t1, len(bound.contact) + 1)[1:]
        for t, tick in zip(times, bound.contact, strict=True):
            follower.tick(t, tick)
            foxglove.log("/trust", state_of(follower, robots))
            time.sleep((times[0] - bound.t0) / faster)
        follower.end(bound.t1, bound.status)
        foxglove.log("/map", grid_of(trust_map, workspace.grid))
        foxglove.log("/path", path_of(follower, workspace.grid))
    campaign.tell(follower.to_mission())


if __name__ == "__main__":
    main()
