"""Messages about a mission that runs, one JSON object a line, and their checks."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from trustbo.answers import PERSON, report_of
from trustbo.data import STATUSES, Cell
from trustbo.errors import TrustboError, one_line, require_known, require_pair, require_whole

MOST_BYTES = 1 << 16
"""Upper limit in bytes of a line."""
_MOST_NOTE = 500  # characters
_ANY = ("t", "token")  # keys of every message; the token is checked where it is needed


class Contact(NamedTuple):
    """Ticks of the bound that runs."""

    n_contact: np.ndarray
    """Number of ticks with contact, (robot,), whole."""
    n_ticks: np.ndarray
    """Number of ticks measured, (robot,), whole."""
    t: float | None


class Marker(NamedTuple):
    """Start of a bound; bound 0 is the start of a mission."""

    bound: int
    cell: Cell | None
    path: tuple[Cell, ...]
    t: float | None


class Ending(NamedTuple):
    """End of a bound."""

    status: str
    note: str
    mission: int | None
    """Number of the mission that it is of; None for the one that runs."""
    t: float | None


class Awareness(NamedTuple):
    """Awareness that robots measured in the bound that runs."""

    values: np.ndarray
    """Shape (robot, feature); NaN where it was not measured."""
    t: float | None


class Pose(NamedTuple):
    """Positions, to be shown."""

    places: dict[str, tuple[float, float]]
    """Position in CRS metres of each robot, or of the lead."""
    t: float | None


class Report(NamedTuple):
    """Trust in robots that a person reports now."""

    values: np.ndarray
    """Reports in [0, 1], (robot,); NaN where none was given."""
    person: str
    t: float | None


Message = Contact | Marker | Ending | Awareness | Pose | Report


class Reader:
    """Reads the messages of a team."""

    def __init__(
        self, robots: Sequence[str], features: Sequence[str], lead: str = "lead", levels: int = 0
    ) -> None:
        """Take the names that messages may use, and the number of levels of reports."""
        self.levels = levels
        self.robots, self.features, self._lead = tuple(robots), tuple(features), lead

    def read(self, line: str | bytes) -> Message:
        """Read a line.

        Args:
            line: A JSON object with one of the keys of `KINDS`.

        Raises:
            TrustboError: The line is too long, no such object, or names what does not exist.
        """
        if len(line) > MOST_BYTES:
            raise TrustboError(f"a message has at most {MOST_BYTES} bytes; got {len(line)}.")
        try:
            record = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise TrustboError(
                f"a message is one line of JSON ({one_line(line)}): {error}."
            ) from None
        return self.of_record(record)

    def of_record(self, record: Any) -> Message:
        """Make the message of a JSON object; TrustboError as of `read`."""
        kinds = [key for key in KINDS if isinstance(record, Mapping) and key in record]
        if len(kinds) != 1:
            raise TrustboError(
                f"a message has one of the keys {', '.join(KINDS)}; got {one_line(record)}."
            )
        read, others = KINDS[kinds[0]]
        if strange := [key for key in record if key not in (kinds[0], *_ANY, *others)]:
            raise TrustboError(
                f"a message of {kinds[0]} has no {one_line(strange[0])}; its keys are "
                f"{', '.join((kinds[0], *others, 't'))}."
            )
        t = record.get("t")
        return read(self, record, None if t is None else _number("t", t))

    def _contact(self, record: Mapping[str, Any], t: float | None) -> Contact:
        given, together = record["contact"], record.get("ticks", 1)
        n = require_whole("ticks", together, 1)
        contacts, ticks = np.zeros((2, len(self.robots)), dtype=np.int64)
        for i, value in _by_name("contact", "robot", self.robots, given):
            if value is True or value is False:
                number = n * value
            elif value is None:
                continue
            else:
                number = _number("contact", value, missing=True)
                if math.isnan(number):
                    continue
                if not 0.0 <= number <= n or (n > 1 and number != int(number)):
                    raise TrustboError(
                        f"contact of {self.robots[i]}: {number:g} is no number of {n} ticks; give "
                        'true or false, or with "ticks" the number of those with contact.'
                    )
                number = int(number > 0.5) if n == 1 else int(number)
            contacts[i], ticks[i] = number, n
        return Contact(contacts, ticks, t)

    def _marker(self, record: Mapping[str, Any], t: float | None) -> Marker:
        for name, own in (("robots", self.robots), ("features", self.features)):
            names = record.get(name)
            if names is not None and (
                not isinstance(names, list) or sorted(map(str, names)) != sorted(own)
            ):
                raise TrustboError(f"{name} are {', '.join(own)}; got {one_line(names)}.")
        cell, path = record.get("cell"), record.get("path") or ()
        cells = tuple(require_pair("path", one) for one in _listed("path", path))
        return Marker(
            require_whole("bound", record["bound"], 0),
            None if cell is None else require_pair("cell", cell),
            cells,
            t,
        )

    def _ending(self, record: Mapping[str, Any], t: float | None) -> Ending:
        status, note = record["status"], record.get("note", "")
        if not isinstance(status, str) or status not in STATUSES:
            raise TrustboError(f"status is one of {', '.join(STATUSES)}; got {one_line(status)}.")
        if not isinstance(note, str) or len(note) > _MOST_NOTE:
            raise TrustboError(f"note is text of at most {_MOST_NOTE} characters.")
        mission = record.get("mission")
        number = None if mission is None else require_whole("mission", mission, 1)
        return Ending(status, note, number, t)

    def _awareness(self, record: Mapping[str, Any], t: float | None) -> Awareness:
        values = np.full((len(self.robots), len(self.features)), np.nan)
        for i, row in _by_name("awareness", "robot", self.robots, record["awareness"]):
            for m, value in _by_name("feature", "feature", self.features, row):
                number = math.nan if value is None else _number("awareness", value, missing=True)
                if not (0.0 <= number <= 1.0 or math.isnan(number)):
                    raise TrustboError(
                        f"awareness of {self.robots[i]}: {number:g} is outside [0, 1]."
                    )
                values[i, m] = number
        return Awareness(values, t)

    def _report(self, record: Mapping[str, Any], t: float | None) -> Report:
        values, person = np.full(len(self.robots), np.nan), record.get("person", PERSON)
        if not isinstance(person, str) or not 0 < len(person.strip()) <= _MOST_NOTE:
            raise TrustboError(f"person is a name; got {one_line(person)}.")
        for i, value in _by_name("report", "robot", self.robots, record["report"]):
            if value is not None:
                number = _number("report", value)
                values[i] = report_of(f"report about {self.robots[i]}", number, self.levels)
        return Report(values, person, t)

    def _pose(self, record: Mapping[str, Any], t: float | None) -> Pose:
        given, places = record["pose"], {}
        if not isinstance(given, Mapping):
            raise TrustboError(f"pose names robots and their x and y; got {one_line(given)}.")
        require_known("robot", given, (self._lead, *self.robots))
        for name, place in given.items():
            x, y = (_number("pose", number) for number in _listed("pose", place, 2))
            places[name] = (x, y)
        return Pose(places, t)


KINDS: dict[
    str, tuple[Callable[[Reader, Mapping[str, Any], float | None], Message], tuple[str, ...]]
] = {
    "contact": (Reader._contact, ("ticks",)),
    "bound": (Reader._marker, ("cell", "path", "mission", "robots", "features")),
    "status": (Reader._ending, ("note", "mission")),
    "awareness": (Reader._awareness, ()),
    "pose": (Reader._pose, ()),
    "report": (Reader._report, ("person",)),
}
"""Keys of messages, with the function that reads each and its further keys."""


def _number(what: str, value: Any, *, missing: bool = False) -> float:
    """Return a number as a float, finite unless it may be missing."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TrustboError(f"{what} must be a number; got {one_line(value)}.")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not (math.isfinite(number) or (missing and math.isnan(number))):
        raise TrustboError(f"{what} must be finite; got {number}.")
    return number


def _by_name(what: str, noun: str, names: Sequence[str], given: Any) -> Iterable[tuple[int, Any]]:
    """Index and value of each robot or feature that is named, or of all, in order."""
    if not isinstance(given, Mapping):
        return enumerate(_listed(what, given, len(names)))
    require_known(noun, given, names)
    return [(names.index(name), value) for name, value in given.items()]


def _listed(what: str, values: Any, n: int | None = None) -> Sequence[Any]:
    if not isinstance(values, list | tuple) or (n is not None and len(values) != n):
        size = "" if n is None else f"{n} "
        raise TrustboError(f"{what} must be a list of {size}values; got {one_line(values)}.")
    return values
