"""One BLAS thread while the package computes, and the caller's number afterwards."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import pytest
from missions import walking_missions
from threadpoolctl import threadpool_info, threadpool_limits

import trustbo as tb
from trustbo.inference import add_latent, loo, params_of
from trustbo.models import PooledTrust, RobotEffect
from trustbo.parallel import one_blas_thread


def blas_threads():
    """Numbers of threads of all BLAS libraries."""
    return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}


@dataclass(frozen=True)
class WatchedEffect(RobotEffect):
    """Robot effect that records the number of BLAS threads whenever its prior is computed."""

    SEEN = set()  # noqa: RUF012

    def prior(self, theta, observations):
        self.SEEN.update(blas_threads())
        return super().prior(theta, observations)


@pytest.fixture
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        yield
        assert blas_threads() == {2}


@pytest.mark.usefixtures("two_threads")
def test_the_last_of_two_overlapping_threads_restores_the_limit():
    first_inside, second_inside, first_left = (threading.Event() for _ in range(3))

    def first():
        with one_blas_thread():
            first_inside.set()
            assert second_inside.wait(10)
        first_left.set()

    def second():
        assert first_inside.wait(10)
        with one_blas_thread():
            second_inside.set()
            assert first_left.wait(10)
            assert blas_threads() == {1}

    with ThreadPoolExecutor(2) as pool:
        for done in (pool.submit(first), pool.submit(second)):
            done.result()


@pytest.mark.usefixtures("two_threads")
def test_an_error_inside_restores_the_limit():
    with pytest.raises(tb.TrustboError), one_blas_thread():
        tb.fit([])


@pytest.mark.usefixtures("two_threads")
def test_all_that_is_computed_from_missions_is_computed_by_one_thread():
    WatchedEffect.SEEN.clear()
    missions = walking_missions(0, 3)
    model = PooledTrust(effects=(WatchedEffect(),))
    with ThreadPoolExecutor(2) as pool:
        fits = [
            pool.submit(tb.fit, missions, model, seed=seed, draws=50, check=False, latent=False)
            for seed in range(2)
        ]
    posterior = add_latent(fits[0].result())
    loo(posterior)
    params_of(posterior)
    assert WatchedEffect.SEEN == {1}
