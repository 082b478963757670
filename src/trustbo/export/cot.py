"""Ways and posts as Cursor on Target, in a data package that ATAK, WinTAK and iTAK import."""

import uuid
import zipfile
from datetime import UTC, datetime, timedelta
from xml.etree import ElementTree as ET

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError
from trustbo.export.checks import require_crs
from trustbo.export.colours import of_robot
from trustbo.export.layers import degrees_of, plan_of
from trustbo.export.schedule import Stand, schedule_of
from trustbo.files import FilePath, require_file, write_file
from trustbo.planning import Plan

_UNKNOWN = "9999999.0"
"""Height and errors that are not known."""
_KEPT = timedelta(days=1)
"""Time after the mission for which events are not stale."""
_HEAD = '<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n'


def write_cot(
    path: FilePath, plan: Plan | Result, *, name: str = "trustbo", start: datetime | None = None
) -> None:
    """Write a route for each robot and a marker for each of its posts as a data package of TAK.

    A package is a zip of Cursor on Target events (`b-m-r` and `b-m-p-s-m`) with a manifest. Events
    have the same uid for the same name, robot and place: those of a later plan replace them.

    Args:
        path: .zip or .dpk file to write, or to replace.
        plan: Plan, or result whose recommended path is meant, on a terrain in memory.
        name: Name of the mission, which its package and events have.
        start: Start of the mission, with a time zone; by default now. Posts begin when they are to
            be occupied; all is stale a day after the end.

    Raises:
        TrustboError: No CRS or no terrain in memory; a robot that has no way in a bound; a start
            without a time zone; or the file cannot be written.
    """
    target = require_file(path, ".zip", ".dpk")
    plan = plan_of(plan)
    require_crs(plan.workspace)
    begin, schedule = begin_of(start), schedule_of(plan)
    end = begin + timedelta(seconds=float(schedule.begins[-1])) + _KEPT
    events = {}
    for i, (robot, stands) in enumerate(schedule.robots.items()):
        places = [degrees_of(plan.workspace, stand.way) for stand in stands]
        argb = _argb(i)
        uid = _uid(name, robot, "way")
        events[uid] = _route(f"{name} {robot}", uid, robot, stands, places, begin, end, argb)
        for stand, way in zip(stands, places, strict=True):
            uid = _uid(name, robot, stand.name)
            since = begin + timedelta(seconds=float(stand.arrives))
            lon, lat = way[-1].tolist()
            event = _event("b-m-p-s-m", uid, begin, since, end, (lat, lon))
            detail = ET.SubElement(event, "detail")
            ET.SubElement(detail, "contact", callsign=f"{robot} {stand.name}")
            ET.SubElement(detail, "color", argb=argb)
            ET.SubElement(detail, "remarks").text = _remarks(stand)
            ET.SubElement(detail, "archive")
            events[uid] = event

    def write(file: FilePath) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as package:
            package.writestr("MANIFEST/manifest.xml", _manifest(name, list(events)))
            for uid, event in events.items():
                package.writestr(f"{uid}/{uid}.cot", _text(event))

    write_file(target, write)


def begin_of(start: datetime | None) -> datetime:
    """Start of a mission, by default now; TrustboError: it has no time zone."""
    if start is None:
        return datetime.now(UTC)
    if not isinstance(start, datetime) or start.tzinfo is None:
        raise TrustboError(
            f"start must be a datetime with a time zone, such as datetime.now(UTC); got {start!r}."
        )
    return start.astimezone(UTC)


def zulu(time: datetime) -> str:
    """Text of a time in UTC, in milliseconds."""
    return time.strftime("%Y-%m-%dT%H:%M:%S.") + f"{time.microsecond // 1000:03d}Z"


def _route(
    callsign: str, uid: str, robot: str, stands: list[Stand], places: list, begin: datetime,
    end: datetime, argb: str,
) -> ET.Element:  # fmt: skip
    """Event of a robot's way: stops have names, bends have none."""
    event = _event("b-m-r", uid, begin, begin, end, None)
    detail = ET.SubElement(event, "detail")
    n = 0
    for k, (stand, way) in enumerate(zip(stands, places, strict=True)):
        points = way if k == 0 else way[1:]
        for j, (lon, lat) in enumerate(points.tolist(), start=1):
            is_stop = j == len(points)
            kind, text = ("b-m-p-w", stand.name) if is_stop else ("b-m-p-c", "")
            ET.SubElement(
                detail, "link", uid=_uid(uid, robot, str(n)), type=kind, callsign=text,
                point=f"{lat:.8f},{lon:.8f}", relation="c", remarks="",
            )  # fmt: skip
            n += 1
    about = {"color": argb, "method": "Driving", "prefix": "CP", "direction": "Infil"}
    about |= {"routetype": "Primary", "order": "Ascending Check Points", "planningmethod": "Infil"}
    ET.SubElement(detail, "link_attr", about, type="Vehicle", stroke="3")
    ET.SubElement(ET.SubElement(detail, "__routeinfo"), "__navcues")
    ET.SubElement(detail, "contact", callsign=callsign)
    ET.SubElement(detail, "remarks").text = f"ways of {robot}"
    ET.SubElement(detail, "archive")
    return event


def _event(
    kind: str, uid: str, time: datetime, start: datetime, stale: datetime,
    place: tuple[float, float] | None,
) -> ET.Element:  # fmt: skip
    event = ET.Element(
        "event", version="2.0", uid=uid, type=kind, time=zulu(time), start=zulu(start),
        stale=zulu(stale), how="m-g",
    )  # fmt: skip
    lat, lon = ("0.0", "0.0") if place is None else (f"{value:.8f}" for value in place)
    ET.SubElement(event, "point", lat=lat, lon=lon, hae=_UNKNOWN, ce=_UNKNOWN, le=_UNKNOWN)
    return event


def _remarks(stand: Stand) -> str:
    if not stand.bound:
        return "around the goal"
    return f"stands here for {stand.hold:.0f} s, from {stand.arrives:.0f} s after the start"


def _manifest(name: str, uids: list[str]) -> str:
    root = ET.Element("MissionPackageManifest", version="2")
    about = ET.SubElement(root, "Configuration")
    for key, value in {"uid": _uid(name, "", "package"), "name": name}.items():
        ET.SubElement(about, "Parameter", name=key, value=value)
    contents = ET.SubElement(root, "Contents")
    for uid in uids:
        one = ET.SubElement(contents, "Content", ignore="false", zipEntry=f"{uid}/{uid}.cot")
        ET.SubElement(one, "Parameter", name="uid", value=uid)
    return _text(root)


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return _HEAD + ET.tostring(root, encoding="unicode") + "\n"


def _uid(*parts: str) -> str:
    """Identifier that the same parts always have."""
    return str(uuid.uuid5(uuid.NAMESPACE_URL, "trustbo:" + "/".join(parts)))


def _argb(index: int) -> str:
    """Colour of a robot as TAK has it: a signed 32-bit number."""
    red, green, blue = of_robot(index)
    return str((0xFF << 24 | red << 16 | green << 8 | blue) - (1 << 32))
