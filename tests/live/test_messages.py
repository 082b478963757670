"""Messages: what a line means, and that any other line is refused in a line."""

import json

import numpy as np
import pytest

from trustbo.errors import TrustboError
from trustbo.live.messages import MOST_BYTES, Reader
from trustbo.live.sources import lines_of

READER = Reader(("r1", "r2", "r3"), ("a", "b"))


@pytest.mark.parametrize(
    ("contact", "contacts", "ticks"),
    [
        ([True, False, None], [1, 0, 0], [1, 1, 0]),
        ({"r3": 1, "r1": 0.4}, [0, 0, 1], [1, 0, 1]),
        ([1.0, float("nan"), 0.51], [1, 0, 1], [1, 0, 1]),
        ({}, [0, 0, 0], [0, 0, 0]),
    ],
)
def test_a_tick_is_one_of_each_robot_that_measured(contact, contacts, ticks):
    message = READER.read(json.dumps({"contact": contact, "t": 2}))
    np.testing.assert_array_equal(message.n_contact, contacts)
    np.testing.assert_array_equal(message.n_ticks, ticks)
    assert message.t == 2.0


def test_robots_may_count_for_themselves():
    message = READER.read('{"contact": {"r2": 150, "r1": 200}, "ticks": 200}')
    np.testing.assert_array_equal(message.n_contact, [200, 150, 0])
    np.testing.assert_array_equal(message.n_ticks, [200, 200, 0])


def test_markers_statuses_awareness_and_poses_are_read():
    marker = READER.read('{"bound": 2, "cell": [1, 0], "mission": 7}')
    assert (marker.bound, marker.cell, marker.path, marker.t) == (2, (1, 0), (), None)
    ending = READER.read('{"status": "stuck", "note": "in mud", "mission": 3}')
    assert (ending.status, ending.note, ending.mission) == ("stuck", "in mud", 3)
    awareness = READER.read('{"awareness": {"r2": {"b": 0.5}, "r1": [0.1, null]}}').values
    np.testing.assert_array_equal(awareness, [[0.1, np.nan], [np.nan, 0.5], [np.nan, np.nan]])
    assert READER.read('{"pose": {"lead": [1, 2.5]}}').places == {"lead": (1.0, 2.5)}


def test_reports_are_on_the_scale_of_the_campaign():
    report = READER.read('{"report": {"r2": 0.5, "r1": null}, "person": "ann"}')
    np.testing.assert_array_equal(report.values, [np.nan, 0.5, np.nan])
    assert report.person == "ann"
    levels = Reader(("r1",), ("a",), levels=7)
    assert levels.read('{"report": [4]}').values == 0.5
    with pytest.raises(TrustboError, match="report about r1 = 0 is no whole number from 1 to 7"):
        levels.read('{"report": [0]}')


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"\x00\xff\xfe", "one line of JSON"),
        ("[" * 50_000, "one line of JSON"),
        ("x" * (MOST_BYTES + 1), "at most 65536 bytes; got 65537"),
        ("[1, 0, 1]", "one of the keys contact, bound, status, awareness, pose"),
        ('{"t": 1}', "one of the keys"),
        ('{"contact": [1, 1, 1], "status": "ok"}', "one of the keys"),
        ('{"contact": [1, 1]}', "contact must be a list of 3 values"),
        ('{"contact": [85, 1, 1]}', "contact of r1: 85 is no number of 1 ticks"),
        ('{"contact": [0.5, 1, 1], "ticks": 2}', "contact of r1: 0.5 is no number of 2 ticks"),
        ('{"contact": ["1", 1, 1]}', "contact must be a number; got '1'"),
        ('{"contact": {"r4": 1}}', "unknown robot 'r4'"),
        ('{"contact": {"r1": 1}, "ticks": 0}', "ticks must be a whole number from 1 on"),
        ('{"contact": {"r1": 1}, "tics": 3}', "a message of contact has no 'tics'"),
        ('{"contact": {"r1": 1}, "t": "now"}', "t must be a number; got 'now'"),
        ('{"contact": {"r1": 1}, "t": 1e999}', "t must be finite"),
        ('{"bound": -1}', "bound must be a whole number from 0 on"),
        ('{"bound": 1, "cell": [0, 0.5]}', "cell must be two whole numbers"),
        ('{"bound": 1, "path": 3}', "path must be a list of values"),
        ('{"bound": 0, "robots": ["r1", "r2"]}', "robots are r1, r2, r3; got"),
        ('{"status": "fine"}', "status is one of ok, stuck"),
        ('{"status": "ok", "note": 3}', "note is text"),
        ('{"awareness": {"r1": [2, 0]}}', r"awareness of r1: 2 is outside \[0, 1\]"),
        ('{"awareness": {"r1": {"c": 0}}}', "unknown feature 'c'"),
        ('{"pose": {"r9": [0, 0]}}', "unknown robot 'r9'"),
        ('{"report": {"r1": 7}}', r"report about r1 = 7 is outside \[0, 1\]"),
        ('{"report": {"r9": 0.5}}', "unknown robot 'r9'"),
        ('{"report": {"r1": true}}', "report must be a number; got True"),
        ('{"report": {"r1": 0.5}, "person": ""}', "person is a name"),
        ('{"pose": {"r1": [0, 0, 0]}}', "pose must be a list of 2 values"),
        ('{"pose": {"r1": [0, true]}}', "pose must be a number"),
    ],
)
def test_any_other_line_is_refused_in_a_line(line, reason):
    with pytest.raises(TrustboError, match=reason) as refused:
        READER.read(line)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 300


class Chunks:
    """A stream that gives its bytes in parts."""

    def __init__(self, *parts):
        self.parts = list(parts)

    def read(self, n):
        return self.parts.pop(0) if self.parts else b""


def test_lines_are_whole_however_a_stream_is_cut():
    stream = Chunks(b"one\ntw", b"o\nthree", b"", b"never")
    assert list(lines_of(stream)) == [[b"one"], [b"two"], [b"three"]]


def test_of_a_line_that_is_too_long_the_beginning_comes_and_the_next_is_whole():
    n = MOST_BYTES
    stream = Chunks(b"a\n" + b"x" * n, b"x" * n, b"x" * n, b"x\nb\n")
    lines = [line for batch in lines_of(stream) for line in batch]
    assert [len(line) for line in lines] == [1, n + 1, 1]
    assert lines[-1] == b"b"
