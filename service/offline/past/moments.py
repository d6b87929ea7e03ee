"""What a page shows of one moment of the past, and the command by which a person goes from one to another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from drivers.frames import LaserScan
from service.encoding import CHANGES, STANDING, Pose, Status
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.edit_requests import RequestModel
from service.outputs import GraphPicture, Grid
from service.web import protocol
from service.web.send_queue import Payload

GO_TO = "moment_go_to"
STALE_NS = 1_500_000_000  # older scans are not of the moment, as on the page of a running service


class GoToRequest(RequestModel):
    """Seconds since the first moment, or since the recording began; behind the last one it means that."""

    position_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One moment as it was known then.

    at_ns        which, Unix time
    poses        base in map, by rising stamps: those around each scan, and the newest as the last of them;
                 what is not known of one is NaN
    path         first and last + 1 of the points of the path that were driven by then
    scans        the newest of each laser, none STALE_NS older than the moment
    mountings    sensor -> pose_base_sensor
    graph        None: as it was shown before
    standing     for how long things stand around the vehicle; None: that is not known
    changes      what differs from the stored map; None: as it was shown before
    statuses     with the Unix time, s, since when each is as it is
    events       Unix time, s, and text of each, oldest first
    map_words    of when the map is that lies below
    """

    at_ns: int
    poses: Sequence[Pose]
    path: tuple[int, int]
    map_words: str
    scans: Sequence[LaserScan] = ()
    mountings: Mapping[str, SE2] | None = None
    graph: GraphPicture | None = None
    standing: Grid | None = None
    changes: Grid | None = None
    statuses: Sequence[tuple[Status, float]] = ()
    events: Sequence[tuple[float, str]] = ()


def payloads_of(moment: Moment, first_ns: int, last_ns: int) -> dict[str, Payload]:
    """Payloads by key, in the order in which a page needs them."""
    payloads: dict[str, Payload] = {}
    if moment.mountings is not None:
        payloads["mountings"] = protocol.mountings_json(moment.mountings)
    payloads["moment"] = protocol.to_json(  # in place of poses and events as they come
        "moment",
        at_s=moment.at_ns / 1e9,
        position_s=(moment.at_ns - first_ns) / 1e9,
        duration_s=(last_ns - first_ns) / 1e9,
        path=moment.path,
        poses=list(map(protocol.pose_fields, moment.poses)),
        map_words=moment.map_words,
        events=protocol.event_fields(moment.events),
    )
    if moment.statuses:
        delay_ms = {scan.sensor: (scan.arrived_ns - scan.stamp_ns) / 1e6 for scan in moment.scans}
        since_s = {status.name: since for status, since in moment.statuses}
        statuses = [status for status, _ in moment.statuses]
        payloads["health"] = protocol.health_json(statuses, since_s, delay_ms, moment.at_ns / 1e9)
    if moment.graph is not None:
        payloads["graph"] = protocol.encode_graph(moment.graph)
    payloads[STANDING] = protocol.encode_standing(moment.standing)
    if moment.changes is not None:
        payloads[CHANGES] = protocol.encode_changes(moment.changes)
    payloads |= {f"scan/{scan.sensor}": protocol.encode_scan(scan) for scan in moment.scans}
    return payloads


def thinned(xy_map: Floats, step_m: float, most: int) -> list[int]:
    """Rows of a path that lie at least `step_m` apart, the step doubled until there are at most `most`.

    xy_map    (N, 2), m; row 0 is among the rows given, where there is one
    """
    while True:
        rows: list[int] = []
        x_m = y_m = np.inf
        for row, (x, y) in enumerate(xy_map.tolist()):
            if not (x - x_m) ** 2 + (y - y_m) ** 2 < step_m**2:
                rows.append(row)
                x_m, y_m = x, y
        if len(rows) <= most:
            return rows
        step_m *= 2.0
