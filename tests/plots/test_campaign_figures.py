"""Parameters and missions over a campaign."""

import numpy as np
import pytest

import trustbo as tb


def bars(ax):
    """Ends of the thin and of the thick bars: (where, low, high)."""
    return [
        [(s[0, 0], *s[:, 1]) for s in collection.get_segments()] for collection in ax.collections
    ]


def test_bars_are_quantiles_of_each_posterior_and_of_the_prior(result):
    axes = tb.plots.parameter_history(result.posteriors)
    titles = [ax.get_title() for ax in axes]
    assert titles[:3] == ["beta0", "beta[traversability]", "beta[visibility]"]
    thin, thick, prior, _ = bars(axes[2])
    for j, posterior in enumerate(result.posteriors):
        draws = posterior["posterior"]["beta"].sel(feature="visibility").values
        np.testing.assert_allclose(thin[j], [j + 1, *np.quantile(draws, [0.05, 0.95])])
        np.testing.assert_allclose(thick[j], [j + 1, *np.quantile(draws, [0.25, 0.75])])
    draws = result.posterior["prior"]["beta"].sel(feature="visibility").values
    np.testing.assert_allclose(prior[0], [0, *np.quantile(draws, [0.05, 0.95])])


def test_parameters_can_be_chosen_and_truths_given(result):
    axes = tb.plots.parameter_history(result.posteriors, names=["b"], truth={"b": 0.1})
    assert [ax.get_title() for ax in axes] == ["b"]
    assert 0.1 in [line.get_ydata()[0] for line in axes[0].lines]
    with pytest.raises(tb.TrustboError, match="unknown parameter 'c'; choose one of beta0"):
        tb.plots.parameter_history(result.posteriors, names=["c"])
    with pytest.raises(tb.TrustboError, match="unknown label in truth 'beta'"):
        tb.plots.parameter_history(result.posteriors, truth={"beta": 0.1})
    with pytest.raises(tb.TrustboError, match="there are no posteriors"):
        tb.plots.parameter_history([])


def test_robots_of_their_own_have_panels_of_their_own():
    rng = np.random.default_rng(1)
    path = [(0, k) for k in range(9)]
    missions = [
        tb.Mission.from_arrays(
            path, rng.uniform(size=(8, 2, 2)), rng.uniform(0.4, 0.9, (8, 2)), robots=("a", "b")
        )
        for _ in range(2)
    ]
    model = tb.models.CoupledTrust(inter_robot="none")
    posterior = tb.fit(missions, model, sampler="exact")
    axes = tb.plots.parameter_history([posterior], names=["beta", "b"])
    titles = [ax.get_title() for ax in axes]
    features = "traversability", "visibility"
    assert titles == [*(f"beta[{r}, {f}]" for r in "ab" for f in features), "b[a]", "b[b]"]
    for ax, robot in zip(axes[-2:], "ab", strict=True):
        draws = posterior["posterior"]["b"].sel(robot=robot).values
        np.testing.assert_allclose(bars(ax)[0][0], [1, *np.quantile(draws, [0.05, 0.95])])


def test_dots_are_missions_and_crosses_those_that_failed(result):
    history = result.history.copy(deep=True)
    history["status"] = ("iteration", ["ok", "stuck"])
    promised, measured = tb.plots.campaign_history(history)
    drawn = {line.get_label(): line for line in measured.lines}
    np.testing.assert_allclose(drawn["not at the goal"].get_xdata(), [2])
    assert [text.get_text() for text in measured.texts] == ["stuck"]
    np.testing.assert_allclose(promised.lines[0].get_ydata(), history["objective"])
    np.testing.assert_allclose(measured.lines[0].get_ydata(), history["contact_rate"])
    shown = np.r_[drawn["a new path"].get_xdata(), drawn["the same path"].get_xdata()]
    assert sorted(shown) == [1, 2]
    assert 1 in drawn["a new path"].get_xdata()


def test_a_campaign_without_missions_has_no_history(result):
    campaign = tb.Campaign(result.workspace, (2, 0), (0, 3))
    with pytest.raises(tb.TrustboError, match="the history has no mission yet"):
        tb.plots.campaign_history(campaign.state.history())
