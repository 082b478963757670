"""Files of a campaign whose stored posterior has been put in another order, as by xarray."""

import copy
from dataclasses import replace

import numpy as np
import xarray as xr

import trustbo as tb


def shuffled(tree, seed=0):
    rng = np.random.default_rng(seed)
    groups = {}
    for name, group in tree.children.items():
        given = group.to_dataset()
        order = {dim: rng.permutation(n) for dim, n in given.sizes.items() if dim in given.indexes}
        groups[name] = given.isel(order).transpose(*rng.permutation(list(given.dims)))
    turned = xr.DataTree.from_dict(groups)
    turned.attrs = tree.attrs
    return turned


def test_exports_and_report_do_not_depend_on_the_order_of_a_posterior(result, tmp_path):
    last = result.state.entries[-1]
    posterior = replace(last.posterior, tree=shuffled(last.posterior()))
    entries = (*result.state.entries[:-1], replace(last, posterior=posterior))
    turned = copy.copy(result)
    turned.state = replace(result.state, entries=entries)
    turned._computed = {}

    formats = ["geotiff", "geojson", "csv", "nav2"]
    folders = []
    for name, one in {"one": result, "other": turned}.items():
        tb.export.export_result(one, tmp_path / name, formats)
        tb.report.write_report(tmp_path / name / "report.html", one)
        folders.append(tmp_path / name)
    files = sorted(path.relative_to(folders[0]) for path in folders[0].rglob("*.*"))
    assert len(files) > len(formats)
    for file in files:
        assert (folders[0] / file).read_bytes() == (folders[1] / file).read_bytes(), file
