"""CPU time and effective draws of fits, compared with NUTS in NumPyro and in PyMC.

    python benchmarks/inference.py [fits] [nuts] [paper] [filter]

`fits`: CPU time of fits of the default model to 15, 60 and 200 missions, and with shared noise or
censored rates. Both the first fit of a process and the median of later fits are printed.
`nuts`: CPU time of `sampler="nuts"` for the default model and eight missions, with compilation, and
the difference of the means to importance sampling.
`paper`: effective draws per second for the paper's model and 600 rates, compared with
`MCMC(NUTS(model.program))` and with PyMC and nutpie.
`filter`: time to update the filter with one bound of three robots, with 1000 draws.
"""

import sys
import time

import jax
import numpy as np
from arviz_stats import sampling_diagnostics
from numpyro.infer import MCMC, NUTS

import trustbo as tb
from trustbo.inference import TrustFilter, sample_prior
from trustbo.inference.diagnostics import diagnostics
from trustbo.models import PlaceEffect, PooledTrust, RobotEffect
from trustbo.models.backend import own_settings

EFFECTS = (PlaceEffect(), RobotEffect())


def missions(n, n_bounds=10, size=10, limit=False, seed=0):
    """Simulate missions of three robots on random walks."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(n):
        path = [tuple(rng.integers(size, size=2).tolist())]
        while len(path) <= n_bounds:
            step = np.array(path[-1]) + rng.integers(-1, 2, size=2)
            if (step >= 0).all() and (step < size).all() and tuple(step.tolist()) != path[-1]:
                path.append(tuple(step.tolist()))
        z = rng.uniform(size=(n_bounds, 3, 2))
        y = 0.2 + 0.5 * z[..., 0] + 0.1 * z[..., 1] + 0.08 * rng.standard_normal((n_bounds, 3))
        y = np.clip(1.6 * y - 0.3 if limit else y, 0.0, 1.0)
        found.append(tb.Mission.from_arrays(path, z, y, features=["line_of_sight", "slope"]))
    return found


def timed_fits():
    """Print the CPU time of fits without predictions."""
    cases = {
        "default model, 15 missions": (15, PooledTrust(effects=EFFECTS), False),
        "60 missions": (60, PooledTrust(effects=EFFECTS), False),
        "200 missions": (200, PooledTrust(effects=EFFECTS), False),
        "15 missions, shared noise": (15, PooledTrust(effects=EFFECTS, shared_noise=True), False),
        "15 missions, censored": (15, PooledTrust(effects=EFFECTS, observation="censored"), True),
    }
    for name, (n, model, limit) in cases.items():
        data, seconds = missions(n, limit=limit), []
        for seed in range(4 if n < 200 else 2):
            started = time.process_time()
            fitted = tb.fit(data, model, seed=seed, whole=False, check=False)
            seconds.append(time.process_time() - started)
        rest = np.median(seconds[1:])
        k_hat = fitted.attrs["k_hat"]
        print(f"{name}: first {seconds[0]:.2f} s, then {rest:.2f} s, k-hat {k_hat:.2f}", flush=True)


def nuts():
    """Print CPU time and error of NUTS for the default model and eight missions."""
    data, model = missions(8), PooledTrust(effects=EFFECTS)
    exact = tb.fit(data, model, draws=4000, whole=False)["posterior"].to_dataset()
    started = time.process_time()
    chains = tb.fit(data, model, sampler="nuts", whole=False, check=False, progress=False)
    seconds, over = time.process_time() - started, ("chain", "draw")
    off = abs(chains["posterior"].to_dataset().mean(over) - exact.mean(over)) / exact.std(over)
    worst = max(float(values.max()) for values in off.data_vars.values())
    print(f"NUTS, 4 x (300 + 1000): {seconds:.0f} s, {diagnostics(chains)}, off by {worst:.3f} sd")


def paper():
    """Print effective draws per second for the paper's model, also of NumPyro and nutpie."""
    data, model = missions(20), PooledTrust().for_features(["line_of_sight", "slope"])
    tb.fit(data, model, whole=False)
    started = time.process_time()
    ours = tb.fit(data, model, whole=False).attrs["kish"] / (time.process_time() - started)
    print(f"paper's model, 600 rates: {ours:.0f} effective draws per second")
    for peer, (draws, seconds) in {"NumPyro": by_numpyro(model, data), **by_nutpie(data)}.items():
        least = min(float(sampling_diagnostics.ess(draws[n])) for n in ("beta0", "delta_w"))
        print(f"{peer}: {least / seconds:.0f} per second, a ratio of {ours * seconds / least:.1f}")


def by_numpyro(model, data):
    """Return draws of NumPyro's NUTS for the program, and the CPU time without compiling."""
    with own_settings():
        mcmc = MCMC(
            NUTS(model.program), num_warmup=500, num_samples=1000, num_chains=4,
            chain_method="vectorized", progress_bar=False,
        )  # fmt: skip
        slots = model.slots(data)
        mcmc.run(jax.random.key(0), slots)
        started = time.process_time()
        mcmc.run(jax.random.key(1), slots)
        draws = {n: np.asarray(v) for n, v in mcmc.get_samples(group_by_chain=True).items()}
    return draws, time.process_time() - started


def by_nutpie(data):
    """Return draws and CPU time of PyMC with nutpie; empty if they are not installed."""
    try:
        from peers.pymc_nutpie import pooled, sampled
    except ImportError as error:
        print(f"skipped: {error}")
        return {}
    z, y = (np.stack([getattr(m, name) for m in data]) for name in ("awareness", "contact_rate"))
    return {"PyMC with nutpie": sampled(pooled(z, y), ("beta0", "delta_w"))}


def one_bound():
    """Print the shortest time that the filter needs for one bound."""
    live = TrustFilter(sample_prior(PooledTrust(), 2, 1000, 0), 3)
    z, y, seconds = np.full((3, 2), 0.5), [0.5, 0.6, 0.7], []
    for _ in range(300):
        started = time.perf_counter()
        live.update(z, y)
        seconds.append(time.perf_counter() - started)
    print(f"TrustFilter, one bound: {1000.0 * min(seconds):.2f} ms")


if __name__ == "__main__":
    parts = {"fits": timed_fits, "nuts": nuts, "paper": paper, "filter": one_bound}
    for part in sys.argv[1:] or parts:
        parts[part]()
