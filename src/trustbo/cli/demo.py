"""`trustbo demo`: the whole of it, on a made terrain."""

from pathlib import Path

from trustbo.cli import options
from trustbo.cli.errors import one_line_errors
from trustbo.cli.outputs import require_outputs
from trustbo.cli.run import require_names, run


def demo(
    policy: options.Policy = "greedy",
    objective: options.Objective = "mean",
    model: options.Model = "pooled",
    sampler: options.Sampler = "nuts",
    iterations: options.Iterations = 8,
    seed: options.Seed = 0,
    config: options.Config = None,
    out: options.Out = Path("out/demo"),
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Run a campaign on a made terrain of 500 m x 500 m, whose DEM and DSM are written out too.

    Example: trustbo demo --sampler exact --iterations 4 --out out/demo

    Then open out/demo/report.html. The objective is the mean trust on the way,
    which makes for a telling picture; that of the paper, the default of run, is
    trust at the goal, which the last few bounds decide.
    """
    from trustbo import terrain
    from trustbo.files import write_file

    with one_line_errors(debug, campaign=out):
        require_names(policy, objective, model, sampler, iterations=iterations, seed=seed)
        require_outputs(out, "dem.tif", "dsm.tif", overwrite=overwrite)
        ground = terrain.synthetic_terrain(seed=seed)
        for name in ("dem", "dsm"):
            raster = ground[name].astype("float32")
            write_file(out / f"{name}.tif", raster.rio.to_raster)
    run(
        dem=out / "dem.tif",
        dsm=out / "dsm.tif",
        start="9,0",
        goal="0,9",
        policy=policy,
        objective=objective,
        model=model,
        sampler=sampler,
        iterations=iterations,
        seed=seed,
        out=out,
        overwrite=overwrite,
        quiet=quiet,
        debug=debug,
    )
