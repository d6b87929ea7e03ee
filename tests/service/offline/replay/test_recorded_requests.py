"""Recordings in which another map was loaded, or the profile switched: a room, driven again."""

import json
import logging
import math
from pathlib import Path

import numpy as np
import pytest

from service.encoding import Message, encode_event, encode_frame, encode_pose, encode_tf_static
from service.errors import InputError
from service.mapstore.files import save_map
from service.offline.replay.replay import ReplayOptions, replay
from tests.service.mapper.drives import MOUNTING, ROOM, Drive, drive, mapper_of, outputs_of, round_the_room
from tests.service.recording.sessions import T0_NS, write_file

LATER_S = 3.0  # than the drive of the stored map the second one begins
AT_S = 2.0  # of the request, after the mountings; the first scan comes after 1 s
AT_NS = T0_NS + round(AT_S * 1e9)
SWITCH = {"event": "switch_profile", "profile": "contour_lm"}


def later(time_s: float):
    return round_the_room(time_s + LATER_S)


@pytest.fixture(scope="module")
def made() -> Drive:
    return drive(ROOM, later, 4.0, every=4, seed=2)


def recorded(path: Path, made: Drive, event: dict[str, object]) -> Path:
    messages: list[Message] = [encode_tf_static({"front": MOUNTING}, T0_NS, T0_NS)]
    messages += [encode_frame(frame, T0_NS) for frame in made.frames]
    messages.append(encode_event(json.dumps(event), AT_NS, AT_NS))
    write_file(path, sorted(messages, key=lambda message: message.log_ns))
    return path


def test_from_the_event_on_the_poses_are_those_in_the_loaded_map(made, tmp_path):
    mapper, folder = mapper_of(), tmp_path / "room"
    outputs_of(mapper, drive(ROOM, round_the_room, 6.0, every=4).frames)
    save_map(folder, mapper.changed_tiles(), 1, graph=mapper.finish().update.saved)
    event = {"event": "load_map", "map": str(folder), "version": 1}
    done = replay([recorded(tmp_path / "later.mcap", made, event)], ReplayOptions())
    before = [output for output in done.outputs if output.stamp_ns < AT_NS]
    after = [output for output in done.outputs if output.stamp_ns > AT_NS]
    assert before[0].pose_map_base.x_m == pytest.approx(0.0, abs=0.01)  # a map of its own
    assert {output.state for output in before} == {"ok"}
    assert (after[0].state, after[-1].state) == ("lost", "degraded")  # seen from one spot so far
    for output in after[-5:]:
        true = round_the_room(0.0).inverse() @ later((output.stamp_ns - T0_NS) * 1e-9 - 1.0)
        away = true.inverse() @ output.pose_map_base
        assert math.hypot(away.x_m, away.y_m) < 0.05
    assert len(np.unique(done.graph.segment)) == 2
    odom = np.array([(o.pose_odom_base.x_m, o.pose_odom_base.y_m) for o in done.outputs])
    assert np.hypot(*np.diff(odom, axis=0).T).max() < 0.12  # odom never jumps


def test_from_the_event_on_the_other_profile_maps_in_a_map_of_its_own(made, tmp_path):
    def poses(outputs) -> list[bytes]:
        return [encode_pose(output, 0).payload for output in outputs]

    done = replay([recorded(tmp_path / "s.mcap", made, SWITCH)], ReplayOptions())
    before = [output for output in done.outputs if output.stamp_ns < AT_NS]
    first = done.outputs[len(before)].pose_map_base
    by_default = replay([recorded(tmp_path / "d.mcap", made, {"event": "mark"})], ReplayOptions()).outputs
    assert poses(before) == poses(by_default[: len(before)])
    np.testing.assert_allclose(np.array(first), 0.0, atol=1e-12)
    assert done.summary["profile"] == "contour_lm"
    assert done.summary["profile_switches"] == [{"at_s": AT_S, "profile": "contour_lm"}]
    assert done.summary["map_resets"] == 1
    assert done.graph is None  # of contour_lm no one can begin in it


def test_a_profile_that_is_asked_for_stays(made, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        done = replay([recorded(tmp_path / "s.mcap", made, SWITCH)], ReplayOptions(profile="corridor"))
    assert done.summary["profile"] == "corridor"
    assert "profile_switches" not in done.summary
    assert done.summary["map_resets"] == 1
    words = f"{AT_S:.3f} s after its beginning the recording was mapped on with the profile contour_lm"
    assert words in caplog.text


def test_a_profile_of_another_version_is_named(made, tmp_path):
    session = recorded(tmp_path / "s.mcap", made, SWITCH | {"profile": "imle2"})
    with pytest.raises(InputError, match=rf"{AT_S:.3f} s after its beginning .* imle2 is no profile; .* --p"):
        replay([session], ReplayOptions())
