"""`trustbo demo`: a campaign on a synthetic terrain."""

from pathlib import Path

from trustbo.campaign.options import POLICY, SAMPLER
from trustbo.cli.errors import one_line_errors
from trustbo.cli.outputs import require_outputs
from trustbo.cli.run import require_names, run


def demo(
    policy: str = POLICY,
    objective: str = "mean",
    model: str = "pooled",
    sampler: str = SAMPLER,
    iterations: int = 8,
    seed: int = 0,
    config: Path | None = None,
    out: Path = Path("out/demo"),
    overwrite: bool = False,
    quiet: bool = False,
    debug: bool = False,
) -> None:
    """Run a campaign on a synthetic terrain of 500 m x 500 m, and write its DEM and DSM too.

    Example: trustbo demo --sampler exact --iterations 4 --out out/demo

    Then open out/demo/report.html. The objective here is the mean trust on the
    way, which every bound changes; the paper's, which is the default of run, is
    trust at the goal, which depends on the last few bounds.
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
