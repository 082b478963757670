"""`trustbo live`: a campaign that is begun, and bad input in a line."""

import pytest

import trustbo as tb


@pytest.fixture
def ends_at_once(monkeypatch):
    """Serve, and end as soon as it is up."""
    import threading

    from trustbo import live

    stop, serve = threading.Event(), live.serve
    stop.set()
    monkeypatch.setattr(live, "serve", lambda *a, **options: serve(*a, **options, stop=stop))


def test_a_campaign_is_begun_once_and_gone_on_with(invoke, rasters, tmp_path, ends_at_once):
    folder = tmp_path / "field"
    flags = ("--dem", rasters / "dem.tif", "--start", "2,0", "--goal", "0,2", "--shape", "3,3")
    own = "--robots", 2, "--bounding", "alternate"
    first = invoke("live", folder, *flags, *own, "--port", 0)
    assert first.exit_code == 0, first.output
    assert f"a campaign was begun in {folder}" in first.output
    assert f"stopped; trustbo live {folder} goes on." in first.output
    again = invoke("live", folder, *flags, "--port", 0)  # the same command
    assert again.exit_code == 0, again.output
    assert "a campaign was begun" not in again.output
    pages = [
        line for out in (first, again) for line in out.output.splitlines() if "#token=" in line
    ]
    assert len({line.partition("#")[2] for line in pages}) == 1
    with tb.Campaign.load(folder) as campaign:
        assert campaign.workspace.team.names == ("r1", "r2")
        assert campaign.workspace.formation.bounding == "alternate"
        assert campaign.planner.start == (2, 0)


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        ((), "holds no campaign; to begin one, give --dem, --start and --goal"),
        (("--dem", "none.tif", "--start", "2,0", "--goal", "0,2"), "none.tif"),
        (
            ("--dem", "none.tif", "--start", "2,0", "--goal", "0,2", "--bounding", "by-turns"),
            "unknown bounding 'by-turns'",
        ),
    ],
)
def test_what_cannot_be_begun_is_an_error_in_a_line(invoke, tmp_path, flags, reason):
    done = invoke("live", tmp_path / "field", *flags)
    assert done.exit_code == 2
    assert reason in str(done.output) + str(done.exception)
    assert not (tmp_path / "field").exists()


def test_flags_of_the_server_are_refused_in_a_line(invoke, finished, tmp_path):
    folder, _ = finished
    for flags, reason in (
        (("--listen", "robots"), "listen must be an IP address"),
        (("--udp", 70_000), "at most 65535"),
        (("--bag", tmp_path / "none.bag"), "there is no bag"),
    ):
        done = invoke("live", folder, *flags)
        assert (done.exit_code, done.output.count("error: ")) == (2, 1)
        assert reason in done.output
