"""Settings of the process and of other libraries, under which trustbo works or says what to do."""

import os
import subprocess
import sys

import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from missions import walking_missions

import trustbo as tb
from trustbo import display
from trustbo.errors import TrustboError, require_docstrings
from trustbo.models.backend import own_flags

CAMPAIGN = """
import numpy as np
import trustbo.errors
try:
    import trustbo as tb
    workspace = tb.Workspace.from_awareness(np.full((2, 3, 3, 2), 0.5))
    print(tb.Campaign(workspace, (2, 0), (0, 2)).ask().path[-1])
except trustbo.errors.TrustboError as error:
    print("refused", error)
"""


def printed(*options, closed="", **environment):
    """Output of a process that plans a path."""
    command = f"exec '{sys.executable}' {' '.join(options)} - {closed}"
    return subprocess.run(
        command, shell=True, input=CAMPAIGN, env=os.environ | environment, text=True,
        stdout=subprocess.PIPE, check=True,
    ).stdout  # fmt: skip


@pytest.mark.slow
def test_a_process_without_stderr_plans():
    assert printed(closed="2>&-") == "(0, 2)\n"


@pytest.mark.slow
def test_kernels_run_without_numba():
    assert printed(NUMBA_DISABLE_JIT="1") == "(0, 2)\n"


@pytest.mark.slow
def test_a_process_without_docstrings_is_refused():
    assert printed("-OO").startswith("refused")
    assert printed("-O") == "(0, 2)\n"


@pytest.mark.slow
@pytest.mark.parametrize("platform", ["cuda", "tpu", "nonsense"])
def test_a_platform_without_a_device_is_named(platform):
    answer = printed(JAX_PLATFORMS=platform)
    assert answer.startswith("refused")
    assert "JAX_PLATFORMS" in answer


class Closed:
    closed = True

    def isatty(self):
        raise ValueError("I/O operation on closed file")


@pytest.mark.parametrize("stderr", [None, Closed()], ids=["none", "closed"])
def test_nothing_is_shown_without_stderr(stderr, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stderr", stderr)
    assert not display.shows_bars()
    display.say("nobody reads this")
    with display.bar(True, total=3) as bar, display.refreshing(bar, 1):
        bar.update(2)
    with display.slow_bar("missions", "missions", True, total=2) as bar:
        bar.update()
    monkeypatch.undo()
    assert capsys.readouterr().out == ""


def test_docstrings_are_required_in_one_sentence(monkeypatch):
    class Flags:
        optimize = 2

    require_docstrings()
    monkeypatch.setattr(sys, "flags", Flags())
    with pytest.raises(TrustboError, match="-OO"):
        require_docstrings()


def own(awareness, contact_rate=None):
    weight = numpyro.sample("weight", dist.Normal(0.5, 0.3))
    with numpyro.plate("mission", len(awareness)):
        law = tb.models.ContactRate(0.6 * weight * awareness[..., 0], 0.4, 0.05, 0.1)
        numpyro.sample("contact_rate", law, obs=contact_rate)


FLAGS = {
    "debug_nans": jax.debug_nans,
    "debug_infs": jax.debug_infs,
    "custom_prng": jax.enable_custom_prng,
    "tracer_leaks": jax.check_tracer_leaks,
    "key_reuse": jax.debug_key_reuse,
}


@pytest.mark.parametrize("flag", FLAGS.values(), ids=FLAGS)
def test_flags_of_jax_change_no_posterior(flag):
    missions = walking_missions(0)
    options = {"draws": 20, "check": False, "progress": False, "seed": 0}
    plain = tb.fit(missions, own, **options)["posterior"]["weight"]
    with flag(True):
        flagged = tb.fit(missions, own, **options)["posterior"]["weight"]
    np.testing.assert_array_equal(flagged, plain)


def test_jit_that_is_switched_off_is_on_in_our_own_calls():
    with jax.disable_jit(), own_flags():
        assert not jax.config.jax_disable_jit


def test_another_error_than_a_missing_device_stays_as_it_is():
    with pytest.raises(RuntimeError, match="mine"), own_flags():
        raise RuntimeError("mine")
