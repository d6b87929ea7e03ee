"""The pose graph as markers: lines that RViz, Foxglove and the operator's page draw alike. The text of the
loops, which these viewers do not draw, holds what the loops rest on, as JSON.
"""

import json
from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from service.encoding import ros_messages as ros
from service.encoding import wire
from service.encoding.wire import Message
from service.geometry.se2 import SE2
from service.outputs import GraphPicture

GRAPH = "graph"  # the channel
# Namespaces of the markers.
PATHS, LOOPS, REFUSED, BORDERS = "key_frames", "loops", "refused_loops", "sub_maps"
_KINDS = {LOOPS: "accepted", REFUSED: "refused"}  # as of GraphPicture.evidence
_LOOK = {  # width in m, colour; one pixel where 40 m fill 500 pixels
    PATHS: (0.08, (0.16, 0.36, 0.85, 1.0)),
    LOOPS: (0.08, (0.10, 0.60, 0.25, 1.0)),
    REFUSED: (0.05, (0.80, 0.15, 0.15, 0.8)),
    BORDERS: (0.05, (0.55, 0.35, 0.75, 0.8)),
}

Lines = npt.NDArray[np.float32]
Marker: TypeAlias = ros.visualization_msgs__msg__Marker


def encode_graph(picture: GraphPicture, log_ns: int) -> Message:
    """All of it in one message, as channel "graph"; its first marker deletes those before."""
    stamp_ns = picture.stamp_ns or log_ns  # of an empty one
    markers = [_marker(stamp_ns, "", 0, Marker.ARROW, Marker.DELETEALL, np.empty((0, 2), np.float32))]
    for name, strips in ((PATHS, picture.paths), (BORDERS, [_closed(border) for border in picture.borders])):
        markers += [
            _marker(stamp_ns, name, number, Marker.LINE_STRIP, Marker.ADD, strip)
            for number, strip in enumerate(strips)
            if len(strip) > 1
        ]
    for name, ends in ((LOOPS, picture.accepted), (REFUSED, picture.refused)):
        if len(ends):
            text = json.dumps(picture.evidence.get(_KINDS[name], []), separators=(",", ":"))
            lines = ends.reshape(-1, 2)
            markers.append(_marker(stamp_ns, name, 0, Marker.LINE_LIST, Marker.ADD, lines, text))
    content = ros.visualization_msgs__msg__MarkerArray(markers)
    return wire.to_message(GRAPH, wire.MARKERS, stamp_ns, log_ns, content)


def decode_graph(payload: bytes) -> GraphPicture:
    """What `encode_graph` made. Raises InputError where the bytes are no MarkerArray."""
    array = cast(ros.visualization_msgs__msg__MarkerArray, wire.read(wire.MARKERS, payload))
    return GraphPicture(
        stamp_ns=max((wire.stamp_ns_of(marker.header.stamp) for marker in array.markers), default=0),
        paths=list(_lines(array.markers, PATHS)),
        accepted=_ends(array.markers, LOOPS),
        refused=_ends(array.markers, REFUSED),
        borders=[border[:-1] for border in _lines(array.markers, BORDERS)],
        evidence={_KINDS[m.ns]: _evidence(m.text) for m in array.markers if m.ns in _KINDS},
    )


def _marker(
    stamp_ns: int, name: str, number: int, kind: int, action: int, xy: Lines, text: str = ""
) -> Marker:
    width_m, colour = _LOOK.get(name, (0.0, (0.0, 0.0, 0.0, 0.0)))
    header = wire.header_ros(stamp_ns, wire.MAP_FRAME)
    nothing = np.empty(0, np.uint8)
    return Marker(
        header=header,
        ns=name,
        id=number,
        type=kind,
        action=action,
        pose=wire.planar_pose_ros(SE2()),
        scale=ros.geometry_msgs__msg__Vector3(width_m, 0.0, 0.0),
        color=ros.std_msgs__msg__ColorRGBA(*colour),
        lifetime=ros.builtin_interfaces__msg__Duration(0, 0),  # stays
        frame_locked=False,
        points=[ros.geometry_msgs__msg__Point(x_m, y_m, 0.0) for x_m, y_m in xy.tolist()],
        colors=[],
        texture_resource="",
        texture=ros.sensor_msgs__msg__CompressedImage(header, "", nothing),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=ros.visualization_msgs__msg__MeshFile("", nothing),
        mesh_use_embedded_materials=False,
    )


def _closed(border: Lines) -> Lines:
    return np.concatenate((border, border[:1]))


def _lines(markers: Sequence[Marker], name: str) -> Iterator[Lines]:
    for marker in markers:
        if marker.ns == name:
            yield np.array([(point.x, point.y) for point in marker.points], np.float32).reshape(-1, 2)


def _evidence(text: str) -> list[dict[str, Any]]:
    """Recordings of before, and markers of others, have none."""
    try:
        read = json.loads(text)
    except (ValueError, RecursionError):
        return []
    return read if isinstance(read, list) and all(isinstance(loop, dict) for loop in read) else []


def _ends(markers: Sequence[Marker], name: str) -> Lines:
    return np.concatenate([np.empty((0, 2), np.float32), *_lines(markers, name)]).reshape(-1, 2, 2)
