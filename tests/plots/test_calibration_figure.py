"""Ranks that are uniform stay in the band; ranks that are not leave it."""

import numpy as np
import pytest
import xarray as xr
from scipy import stats

import trustbo as tb

N = 200


def ranks_of(pit):
    coverage = [[np.mean(np.abs(pit - 0.5) < width / 2)] for width in (0.5, 0.9)]
    return xr.Dataset(
        {
            "pit": (("dataset", "parameter"), pit[:, None]),
            "coverage": (("interval", "parameter"), coverage),
        },
        {"parameter": ["b"], "interval": [0.5, 0.9]},
        {"sampler": "exact"},
    )


@pytest.mark.parametrize(("power", "calibrated"), [(1.0, True), (2.0, False)])
def test_curves_are_kolmogorov_smirnov_s_and_the_band_its_quantile(power, calibrated):
    pit = np.random.default_rng(0).uniform(size=N) ** power
    curves, cover = tb.plots.calibration(ranks_of(pit))
    farthest = np.abs(curves.lines[0].get_ydata()).max()
    test = stats.kstest(pit, "uniform")
    np.testing.assert_allclose(farthest, test.statistic)
    box = curves.patches[0]
    assert (farthest <= box.get_y() + box.get_height()) == (test.pvalue >= 0.05) == calibrated
    shares = next(line for line in cover.lines if line.get_marker() == "o").get_ydata()
    np.testing.assert_allclose(shares[1], np.mean(np.abs(pit - 0.5) < 0.45))


def test_it_takes_what_sbc_returns():
    ranks = tb.inference.sbc(n_datasets=5, shape=(2, 4, 2, 2), n_ranked=40, progress=False)
    curves, _ = tb.plots.calibration(ranks)
    assert len(curves.lines) == ranks.sizes["parameter"]
    (legend,) = curves.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == list(ranks["parameter"].values)
