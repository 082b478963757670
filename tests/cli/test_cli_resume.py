"""`trustbo resume`: after Ctrl-C, for more missions, and when a posterior was refused."""

import json
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import typer
import xarray as xr

import trustbo as tb
from trustbo.cli.errors import one_line_errors

# Shells start background jobs with SIGINT ignored, which children inherit.
PROGRAM = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from trustbo.cli import main; main(sys.argv[1:])"
)


def fill_disk(process):
    """Let no file of a process be longer than 1000 bytes from now on."""
    hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)[1]
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (1000, hard))


def struck(words, out, n_posteriors, strike):
    """Exit code and stderr of the program that is struck when so many posteriors are written."""
    command = [sys.executable, "-c", PROGRAM, *(str(a) for a in words)]
    awaited = out / "posteriors" / f"{n_posteriors:04d}.nc"
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            deadline = time.monotonic() + 120
            while not awaited.exists() and time.monotonic() < deadline:
                assert process.poll() is None, process.communicate()[1]
                time.sleep(0.05)
            strike(process)
            said = process.communicate(timeout=60)[1]
        finally:
            process.kill()  # or a test that fails would wait for it
    assert "Traceback" not in said
    return process.returncode, said


@pytest.mark.slow  # processes start for long; in one, test_resume dies at every write
@pytest.mark.usefixtures("blank_figures")
def test_what_is_done_is_kept_and_resume_goes_on(invoke, flags, tmp_path):
    """To the same result as without the interruptions: Ctrl-C, SIGTERM and a full disk."""
    out, n = tmp_path / "out", 0
    words = ["run", *flags, "--seed", 2, "--quiet", "--iterations"]
    for command, strike, code, message in (
        (words, lambda p: p.send_signal(signal.SIGINT), 130, "kept: trustbo resume {} goes on."),
        (None, lambda p: p.send_signal(signal.SIGTERM), 130, "kept: trustbo resume {} goes on."),
        (None, fill_disk, 2, "error: the disk is full: '{}/"),
    ):
        again = ["resume", out, "--quiet", "--iterations", 500]
        ran = again if command is None else [*command, 500, "--out", out]
        found, said = struck(ran, out, n + 2, strike)
        assert found == code, said
        assert message.format(out) in said.splitlines()[-1]
        before, n = n, json.loads((out / "campaign.json").read_text())["n_missions"]
        assert before < n < 500
    done = invoke("resume", out, "--iterations", n + 1, "--quiet")
    assert done.exit_code == 0, done.output
    assert invoke(*words, n + 1, "--out", tmp_path / "whole").exit_code == 0
    again, whole = tb.load_result(out), tb.load_result(tmp_path / "whole")
    assert len(again.missions) == n + 1
    assert (again.path, again.stop_reason) == (whole.path, whole.stop_reason)
    for a, b in zip(again.posteriors, whole.posteriors, strict=True):
        xr.testing.assert_identical(a["posterior"].to_dataset(), b["posterior"].to_dataset())
    assert (out / "report.html").exists()


def test_resume_says_what_it_cannot_do(invoke, tmp_path):
    done = invoke("resume", tmp_path)
    assert done.exit_code == 2
    assert "holds no campaign; give the --out of trustbo run" in done.stderr
    workspace = tb.Workspace.from_awareness(np.full((2, 3, 3, 2), 0.5))
    with tb.Campaign(workspace, (2, 0), (0, 2), directory=tmp_path):
        pass
    done = invoke("resume", tmp_path)
    assert done.exit_code == 2
    assert "was run by robots of your own, not by trustbo run" in done.stderr


def test_a_refused_posterior_is_exit_3_and_says_what_is_kept(tmp_path, capsys):
    with pytest.raises(typer.Exit) as ended, one_line_errors(debug=False, campaign=tmp_path):
        raise tb.PosteriorError("posterior refused after a longer retry: 7 divergences.")
    assert ended.value.exit_code == 3
    error, hint = capsys.readouterr().err.splitlines()
    assert error == "error: posterior refused after a longer retry: 7 divergences."
    assert hint.startswith(
        f"hint: the measured missions are kept in {tmp_path}/measured.nc. Run again"
    )
    with pytest.raises(tb.PosteriorError), one_line_errors(debug=True):
        raise tb.PosteriorError("posterior refused.")


def test_an_interruption_before_anything_was_begun_says_so(tmp_path, capsys):
    with pytest.raises(typer.Exit) as ended, one_line_errors(debug=False, campaign=tmp_path):
        raise KeyboardInterrupt
    assert ended.value.exit_code == 130
    assert "interrupted; nothing was begun yet." in capsys.readouterr().err
