"""A recording in which another map was loaded on the way."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.encoding import Message, encode_event, encode_frame, encode_tf_static
from service.mapper.profiles import mapping_config
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import save_map
from service.offline.replay.replay import ReplayOptions, replay
from simulators.worlds import WORLDS
from tests.service.recording.sessions import T0_NS, write_file
from tests.simulated import FORWARD, LMS100_50HZ, Drive, Wheels, drive, run

LASER, FINER = (replace(LMS100_50HZ, rate_hz=rate_hz) for rate_hz in (12.5, 25.0))
LOADED_S, LATER_S = 2.0, 12.0


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> tuple[Drive, Path]:
    made = drive(WORLDS["office"](), LASER, 30.0, 3, Wheels())
    mapper = run(mapping_config(), made).mapper
    graph = mapper.finish().update.saved
    assert isinstance(graph, SavedGraph)
    folder = tmp_path_factory.mktemp("maps") / "office"
    save_map(folder, mapper.changed_tiles(), 1, graph=graph)
    return made, folder


@pytest.fixture(scope="module")
def second() -> Drive:
    return drive(WORLDS["office"](), FINER, 8.0, 4, Wheels(), stand_s=-LATER_S)


def recorded(path: Path, made: Drive, event: dict[str, object]) -> Path:
    messages: list[Message] = [encode_tf_static({"front": FORWARD}, T0_NS, T0_NS)]
    messages += [encode_frame(frame, T0_NS) for frame in made.frames]
    at_ns = T0_NS + round(LOADED_S * 1e9) + 1
    messages.append(encode_event(json.dumps(event), at_ns, at_ns))
    write_file(path, sorted(messages, key=lambda message: message.log_ns))
    return path


def test_from_the_event_on_the_poses_are_those_in_the_loaded_map(first, second, tmp_path):
    (drove, folder) = first
    event = {"event": "load_map", "map": str(folder), "version": 1}
    done = replay([recorded(tmp_path / "later.mcap", second, event)], ReplayOptions())
    at_ns = T0_NS + round(LOADED_S * 1e9)
    before = [output for output in done.outputs if output.stamp_ns < at_ns]
    after = [output for output in done.outputs if output.stamp_ns > at_ns]
    assert before[0].pose_map_base.x_m == pytest.approx(0.0, abs=0.01)  # a map of its own
    assert {output.state for output in before} == {"ok"}
    assert after[0].state == "lost"
    assert after[-1].state == "ok"
    for output in after[-5:]:
        true = drove.world_first.inverse() @ second.world_first @ second.truth[output.stamp_ns - T0_NS]
        away = true.inverse() @ output.pose_map_base
        assert math.hypot(away.x_m, away.y_m) < 0.05
    assert done.graph is not None
    assert len(np.unique(done.graph.segment)) == 2
    odom = np.array([(o.pose_odom_base.x_m, o.pose_odom_base.y_m) for o in done.outputs])
    assert np.hypot(*np.diff(odom, axis=0).T).max() < 0.1  # odom never jumps
