"""A campaign in a folder, copied for each test."""

import json
import shutil
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager

import pytest
from worlds import begin, random_cells

from trustbo.live import serve


@pytest.fixture(scope="session")
def learned(tmp_path_factory):
    """The folder of a campaign with one mission of three robots on 4 x 4 cells."""
    folder = tmp_path_factory.mktemp("learned") / "campaign"
    begin(random_cells(), folder, 1)
    return folder


@pytest.fixture
def folder(learned, tmp_path):
    """A copy of it, free to be changed."""
    return shutil.copytree(learned, tmp_path / "campaign")


class Served:
    """A server in a thread, and calls to it."""

    def __init__(self, folder, said):
        self.folder, self.said, self.lines = folder, said, said[0].splitlines()
        self.page, _, self.token = self.lines[0].split()[1].partition("#token=")

    def port_of(self, kind):
        return int(next(line for line in self.lines if line.startswith(kind)).rpartition(":")[2])

    def call(self, path, data=None, token=None):
        head = {"Authorization": f"Bearer {self.token if token is None else token}"}
        request = urllib.request.Request(self.page + path, data, head)
        try:
            with urllib.request.urlopen(request, timeout=30) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read().decode()

    def tell(self, *messages):
        lines = "\n".join(map(json.dumps, messages)).encode()
        status, text = self.call("api/messages", lines)
        return status, json.loads(text)

    def state(self):
        return json.loads(self.call("api/state")[1])

    def until(self, condition):
        """State once it fulfils a condition, within half a minute."""
        for _ in range(600):
            state = self.state()
            if condition(state):
                return state
            time.sleep(0.05)
        raise AssertionError(state)


@pytest.fixture(scope="session")
def serving():
    """Serve a folder until the end of a block: `with serving(folder, **options) as served`."""
    return _serving


@contextmanager
def _serving(folder, **options):
    said, stop, errors = [], threading.Event(), []
    is_up = threading.Event()

    def run():
        try:
            serve(
                folder, port=0, stop=stop, ready=lambda t: (said.append(t), is_up.set()), **options
            )
        except BaseException as error:
            errors.append(error)
            is_up.set()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert is_up.wait(60)
        if errors:
            raise errors[0]
        yield Served(folder, said)
    finally:
        stop.set()
        thread.join()
