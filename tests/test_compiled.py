"""Compiled code is stored in one folder, and no other processor or library reads it."""

import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numba
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from trustbo import compiled
from trustbo.kernels import kernel
from trustbo.models.backend import own_settings

SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_persistent_cache_min_compile_time_secs",
)


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """A new folder of compiled code, as for a user without settings of JAX or numba."""

    def forget():
        compiled.folder_of.cache_clear()
        compiled.warn_of_no_storage.cache_clear()
        compilation_cache.reset_cache()

    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv(compiled.VARIABLE, str(tmp_path / "code"))
    forget()
    yield tmp_path / "code"
    jax.config.update("jax_compilation_cache_dir", before)
    forget()


def settings():
    """JAX's settings of its cache."""
    return [getattr(jax.config, name) for name in SETTINGS]


def run(factor):
    """Compile and run a program that depends on the factor."""
    return jax.jit(lambda x: (factor * x) @ jnp.sin(x))(np.eye(3)).tolist()


def stored(folder, ending="-cache"):
    """Files of compiled code."""
    return sorted(folder.rglob(f"*{ending}"))


def test_programs_are_read_by_the_next_compilation(fresh):
    with own_settings():
        first = run(2.0)
        (entry,) = stored(fresh)

        assert run(2.0) == first
        assert stored(fresh) == [entry]
        run(3.0)
    assert len(stored(fresh)) == 2


def test_programs_of_the_user_are_not_stored_and_settings_are_as_before(fresh):
    before = settings()
    with own_settings():
        assert settings() != before
    run(4.0)
    assert settings() == before
    assert stored(fresh) == []


def test_settings_return_when_the_last_thread_leaves(fresh):
    before = settings()
    inside, leave = threading.Event(), threading.Event()

    def work():
        with own_settings():
            inside.set()
            leave.wait()

    other = threading.Thread(target=work)
    with own_settings():
        other.start()
        inside.wait()
    assert settings() != before
    leave.set()
    other.join()
    assert settings() == before


def test_a_cache_of_the_user_is_left_alone(fresh, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "user"))
    before = settings()
    with own_settings():
        assert settings() == before
        run(5.0)
    assert stored(fresh) == []


def test_a_damaged_program_is_compiled_again(fresh):
    with own_settings():
        expected = run(6.0)
    (entry,) = stored(fresh)
    entry.write_bytes(entry.read_bytes()[:100])

    with own_settings(), pytest.warns(UserWarning, match="persistent compilation cache"):
        assert run(6.0) == expected


def test_kernels_are_stored_in_the_same_folder(fresh):
    made = kernel()(lambda x: x + 1.0)
    assert made(1.0) == 2.0
    assert {file.relative_to(fresh).parts[0][:6] for file in stored(fresh, ".nbi")} == {"numba-"}
    assert numba.config.CACHE_DIR == ""


def test_kernels_follow_a_setting_of_numba(fresh, tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "user"))
    kernel()(lambda x: x + 2.0)(1.0)
    assert stored(tmp_path / "user", ".nbi")
    assert not fresh.exists()


def test_nothing_is_stored_if_storage_is_off(fresh, monkeypatch):
    monkeypatch.setenv(compiled.VARIABLE, "off")
    assert kernel()(lambda x: x + 3.0)(1.0) == 4.0
    with own_settings():
        run(7.0)
    assert not fresh.exists()


@pytest.mark.parametrize("problem", ["no folder", "full disk"])
def test_code_that_cannot_be_stored_is_compiled_with_one_warning(fresh, monkeypatch, problem):
    if problem == "no folder":
        fresh.write_text("a file")
    else:
        monkeypatch.setattr(compiled, "_FREE", 1e18)

    with pytest.warns(UserWarning, match="TRUSTBO_CACHE"):
        made = kernel()(lambda x: x + 4.0)
    assert made(1.0) == 5.0
    with own_settings():  # another warning would be an error
        run(8.0)


def test_each_processor_and_version_has_its_own_folder():
    facts = {"system": "Linux", "machine": "x86_64", "features": "+avx2", "XLA_FLAGS": ""}
    keys = [compiled.key_of("jaxlib 0.12.0", facts), compiled.key_of("jaxlib 0.12.1", facts)]
    keys += [compiled.key_of("jaxlib 0.12.0", facts | {name: "other"}) for name in facts]
    assert len(set(keys)) == len(keys)
    assert compiled.key_of("jaxlib 0.12.0", dict(reversed(facts.items()))) == keys[0]


@pytest.mark.slow  # compiles a model in a fresh process, twice
def test_another_process_finds_the_programs_of_a_function(tmp_path):
    """Whatever the order in which this process lists the members of a set."""
    program = (
        "import numpy as np, numpyro\n"
        "from numpyro import distributions as dist\n"
        "import trustbo as tb\n"
        "def model(awareness, contact_rate=None):\n"
        "    sds = dist.LogNormal(-3.0, 0.5).expand((2,)).to_event(1)\n"
        "    delta_w, delta_v = numpyro.sample('sd', sds)\n"
        "    b = numpyro.sample('b', dist.TruncatedNormal(0.5, 0.2, low=0.0))\n"
        "    with numpyro.plate('mission', len(awareness)):\n"
        "        rates = tb.models.ContactRate(b * awareness[..., 0], 0.5, delta_w, delta_v)\n"
        "        numpyro.sample('contact_rate', rates, obs=contact_rate)\n"
        "z = np.linspace(0.1, 0.9, 6).reshape(3, 2, 1)\n"
        "mission = tb.Mission.from_arrays([(0, 0), (0, 1), (0, 2), (0, 3)], z, z[..., 0])\n"
        "tb.fit([mission], model, check=False, progress=False)\n"
    )
    environment = {name: v for name, v in os.environ.items() if not name.startswith("JAX_")}
    environment[compiled.VARIABLE] = str(tmp_path)

    def fit(seed):
        command = [sys.executable, "-W", "ignore", "-c", program]
        subprocess.run(command, env=environment | {"PYTHONHASHSEED": seed}, check=True)
        return stored(tmp_path)

    first = fit("1")
    assert first
    assert fit("2") == first
