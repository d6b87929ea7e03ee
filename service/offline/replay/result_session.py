"""The result of a replay as a session of ROS 2 messages: what it found, for viewers of MCAP."""

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from service.encoding import (
    LEVEL_OF_STATE,
    Message,
    Status,
    encode_diagnostics,
    encode_graph,
    encode_grid,
    encode_odom,
    encode_pose,
    encode_tf,
    encode_tf_static,
)
from service.errors import StorageError
from service.mapper.graph.model.graph_picture import draw_saved
from service.mapstore.tiles import grid_of_tiles
from service.offline.importing.session_file import write_messages
from service.offline.replay.states_file import sigmas_of
from service.outputs import MapperOutput

if TYPE_CHECKING:
    from service.offline.replay.result import Replay

log = logging.getLogger(__name__)

RESULT_SESSION = "session.mcap"


def write_result_session(path: Path, done: "Replay") -> None:
    """The map and the graph as they are in the end at the first stamp; from there on `/pose`, `/odom`, `/tf`
    and `/diagnostics` of each scan at its own stamp. Poses are those of trajectory.tum, covariances and
    states as live. A map that is too large for one message is left out.

    Raises StorageError.
    """
    about = {"corridor": str(done.summary["corridor"]), "profile": str(done.summary["profile"])}
    write_messages(path, _messages(done), {"replay": about})


def _messages(done: "Replay") -> Iterator[Message]:
    first_ns = done.outputs[0].stamp_ns
    yield encode_tf_static(done.poses_base_sensor, first_ns, first_ns, upside_down=done.upside_down)
    try:
        yield encode_grid(grid_of_tiles(done.tiles), first_ns, first_ns)
    except StorageError as error:
        log.warning("%s has no /map: %s", RESULT_SESSION, error)
    if (graph := done.graph or done.session) is not None:
        yield encode_graph(draw_saved(graph), first_ns)
    for output, pose_map_base, laser in zip(done.outputs, done.poses_map_base, done.lasers, strict=True):
        at = replace(output, pose_map_odom=pose_map_base @ output.pose_odom_base.inverse())
        for encode in (encode_pose, encode_odom, encode_tf):
            yield encode(at, output.stamp_ns)
        yield encode_diagnostics("diagnostics", [_status(output, laser)], output.stamp_ns, output.stamp_ns)


def _status(output: MapperOutput, laser: str) -> Status:
    along_m, across_m, heading_deg = sigmas_of(output)
    values = {
        "state": output.state,
        "reason_id": output.reason.id,
        "sigma_along_m": f"{along_m:.4f}",
        "sigma_across_m": f"{across_m:.4f}",
        "sigma_heading_deg": f"{heading_deg:.4f}",
        "inlier_ratio": f"{output.inlier_ratio:.3f}",
        "laser": laser,
    }
    return Status("mapping", LEVEL_OF_STATE[output.state], output.reason or output.state, values)
