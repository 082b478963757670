"""The composite index: oriented by declared signs, in [0, 1], honest about what it lost."""

import numpy as np
import pytest
import xarray as xr

from trustbo.errors import TrustboError
from trustbo.terrain import CompositeIndex


def correlated(n=4000, seed=0, third=-1.0):
    rng = np.random.default_rng(seed)
    common = rng.normal(size=n)
    arrays = {
        "slope": 10 + 3 * common + rng.normal(size=n),
        "tri": 1 + 0.2 * common + 0.05 * rng.normal(size=n),
        "open": third * common + 0.3 * rng.normal(size=n),
    }
    return xr.Dataset({name: ("pixel", values) for name, values in arrays.items()})


SIGNS = {"slope": -1, "tri": -1, "open": +1}


def test_the_first_component_is_numpy_s_up_to_the_declared_sign():
    features = correlated()
    index = CompositeIndex(SIGNS).fit(features)
    x = np.stack([features[name].values for name in SIGNS], axis=1)
    x = np.clip(x, *np.percentile(x, [1, 99], axis=0))
    values, vectors = np.linalg.eigh(np.corrcoef(x.T))
    first = vectors[:, -1] * np.sign(vectors[:, -1] @ list(SIGNS.values()))
    np.testing.assert_allclose(index.loadings_, first, rtol=1e-6)
    np.testing.assert_allclose(index.explained_variance_ratio_, values[::-1] / 3, rtol=1e-6)


def test_more_slope_lowers_the_index_whatever_the_solver_s_sign():
    features = correlated()
    for flip in (1, -1):
        signs = {name: flip * sign for name, sign in SIGNS.items()}
        index = CompositeIndex(signs).fit(features).transform(features)
        correlation = np.corrcoef(index, features["slope"])[0, 1]
        assert np.sign(correlation) == -flip


def test_two_percent_at_either_end_are_cut():
    features = correlated()
    index = CompositeIndex(SIGNS).fit(features).transform(features)
    assert (index == 0.0).mean() == pytest.approx(0.02, abs=0.002)
    assert (index == 1.0).mean() == pytest.approx(0.02, abs=0.002)


def test_missing_pixels_stay_missing_and_do_not_count():
    features = correlated()
    holes = features.copy(deep=True)
    holes["tri"][:100] = np.nan
    index = CompositeIndex(SIGNS).fit(holes)
    kept = CompositeIndex(SIGNS).fit(features.isel(pixel=slice(100, None)))
    np.testing.assert_allclose(index.loadings_, kept.loadings_)
    assert np.isnan(index.transform(holes)[:100]).all()


def test_a_constant_feature_has_no_say():
    features = correlated().assign(tri=("pixel", np.full(4000, 7.0)))
    index = CompositeIndex(SIGNS).fit(features)
    assert float(index.loadings_.sel(feature="tri")) == 0.0
    assert np.isfinite(index.transform(features)).all()
    flat = xr.Dataset({name: ("pixel", np.ones(10)) for name in SIGNS})
    np.testing.assert_array_equal(CompositeIndex(SIGNS).fit(flat).transform(flat), 0.5)


def test_a_feature_against_its_sign_is_named():
    with pytest.warns(UserWarning, match="'open' has the opposite sign"):
        CompositeIndex(SIGNS).fit(correlated(third=+1.0))


@pytest.mark.filterwarnings("ignore:the loading of")
def test_a_component_that_explains_little_is_reported():
    rng = np.random.default_rng(0)
    noise = xr.Dataset({name: ("pixel", rng.normal(size=2000)) for name in SIGNS})
    signs = {name: +1 for name in SIGNS}
    with pytest.warns(UserWarning, match="explains only 3"):
        CompositeIndex(signs).fit(noise)


def test_a_few_obstacles_on_flat_ground_are_the_low_end():
    features = xr.Dataset({name: ("pixel", np.zeros(1000)) for name in ("slope", "tri")})
    for name in features:
        features[name][:15] = 1.0  # winsorising leaves them, the 2nd percentile does not
    index = CompositeIndex({"slope": -1, "tri": -1}).fit(features).transform(features)
    np.testing.assert_array_equal(index[:15], 0.0)
    np.testing.assert_array_equal(index[15:], 1.0)


def test_bad_input():
    with pytest.raises(TrustboError, match="open"):
        CompositeIndex(SIGNS).fit(correlated().drop_vars("open"))
    empty = xr.Dataset({name: ("pixel", np.full(5, np.nan)) for name in SIGNS})
    with pytest.raises(TrustboError, match="no pixel"):
        CompositeIndex(SIGNS).fit(empty)
    with pytest.raises(TrustboError, match="feature"):
        CompositeIndex({})


def test_samples_are_matched_by_their_dims():
    common, noise = np.random.default_rng(0).normal(size=(2, 40, 40))
    values = {"slope": common, "tri": common + 0.1 * noise, "open": noise - common}
    features = xr.Dataset({name: (("y", "x"), x) for name, x in values.items()})
    turned = features.assign(tri=features["tri"].transpose("x", "y"))
    for given in (turned, dict(turned.data_vars)):
        index = CompositeIndex(SIGNS).fit(given)
        xr.testing.assert_identical(index.fitted, CompositeIndex(SIGNS).fit(values).fitted)
        np.testing.assert_array_equal(index.transform(given), index.transform(values))


def test_a_fitted_index_is_read_back_as_it_was(tmp_path):
    features = correlated()
    index = CompositeIndex(SIGNS).fit(features)
    index.fitted.to_netcdf(tmp_path / "index.nc")
    again = CompositeIndex(SIGNS, xr.load_dataset(tmp_path / "index.nc"))
    xr.testing.assert_identical(again.loadings_, index.loadings_)
    np.testing.assert_array_equal(again.transform(features), index.transform(features))
