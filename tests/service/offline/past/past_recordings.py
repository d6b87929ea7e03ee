"""A recording of a drive in which much happens, and when it did."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from service.encoding import Message, encode_graph, encode_grid, encode_pose
from service.mapstore.tiles import TileStore
from service.outputs import GraphPicture, Grid
from tests.browser.scene import Scene, event, stamp
from tests.service.recording.sessions import write_file

LASTS_S = 20.0
PERIOD_S = 0.1  # of poses and scans of both lasers
DEGRADED_S = (7.0, 9.0)  # reported by the health of each second
MAPS_S = {5.0: (4.0, 2.5), 10.0: (8.0, 5.0), 15.0: (6.0, 3.0)}  # half width and height of the room shown
MARK_S, GRAPH_S, RESET_S = 3.0, 6.0, 12.05
CHANGED_S = {3.0: 100, 5.0: 0}  # of one cell, which is new and then gone
STANDING_S = {2.0: 20, 4.0: 40, 14.0: 60}  # of one cell, per cent
REAR_ENDS_S, POSES_END_S = 14.0, 17.0  # no scan of rear, no pose, from then on
NO_ENDS = np.empty((0, 2, 2), np.float32)


def room(half_x_m: float, half_y_m: float) -> Grid:
    store = TileStore()
    Scene(half_x_m, half_y_m, store).map_all()
    return store.grid()


def past_messages() -> list[Message]:
    """By rising log times."""
    scene = Scene()
    messages = []
    for k in range(round(LASTS_S / PERIOD_S) + 1):
        seconds = k * PERIOD_S
        is_degraded = DEGRADED_S[0] <= seconds < DEGRADED_S[1]
        mountings, pose, front, rear, health = scene.messages(seconds, "degraded" if is_degraded else "ok")
        messages += [front] if seconds >= REAR_ENDS_S else [front, rear]
        also = replace(scene.output(seconds), stamp_ns=stamp(seconds) + 1)  # of the other laser's scan
        if seconds < POSES_END_S:
            messages += [pose, encode_pose(also, pose.log_ns + 1)]
        messages += [health] if k % 10 == 0 else []
        messages += [mountings] if k == 0 else []
        messages.append(event('{"event": "apply_result"}', seconds))
    path = np.array([(0.0, 0.0), (1.0, 1.0)], np.float32)
    messages += [encode_grid(room(*half_m), stamp(s), stamp(s)) for s, half_m in MAPS_S.items()]
    messages += [encode_graph(GraphPicture(stamp(GRAPH_S), [path], NO_ENDS, NO_ENDS), stamp(GRAPH_S))]
    messages += [
        event('{"event": "mark", "text": "a door"}', MARK_S),
        event('{"event": "reset_map"}', RESET_S),
    ]
    for seconds, percent in STANDING_S.items():
        stands = Grid(0, 0.1, 1.0, 1.0, np.full((1, 1), percent, np.int8))
        messages.append(encode_grid(stands, stamp(seconds), stamp(seconds), "standing"))
    for seconds, value in CHANGED_S.items():
        changed = Grid(0, 0.1, 2.0, 2.0, np.full((1, 1), value, np.int8))
        messages.append(encode_grid(changed, stamp(seconds), stamp(seconds), "map/changes"))
    return sorted(messages, key=lambda message: message.log_ns)


def write_past(folder: Path, cut_s: float | None = None) -> list[Path]:
    """In one file, or in two that are cut at that second; the second begins with the mountings again."""
    messages = past_messages()
    if cut_s is None:
        write_file(folder / "drive_0001.mcap", messages)
        return [folder / "drive_0001.mcap"]
    for number, part in ((1, lambda m: m.log_ns < stamp(cut_s)), (2, lambda m: m.log_ns >= stamp(cut_s))):
        write_file(folder / f"drive_000{number}.mcap", filter(part, messages))
    return [folder / "drive_0001.mcap", folder / "drive_0002.mcap"]
