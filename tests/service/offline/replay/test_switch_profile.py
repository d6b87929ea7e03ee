"""A recording in which the profile was switched on the way."""

import logging

import numpy as np
import pytest

from service.encoding import encode_pose
from service.errors import InputError
from service.offline.replay.replay import ReplayOptions, replay
from simulators.worlds import WORLDS
from tests.service.offline.replay.test_load_map import LASER, LOADED_S, recorded
from tests.service.recording.sessions import T0_NS
from tests.simulated import Drive, Wheels, drive

AT_NS = T0_NS + round(LOADED_S * 1e9)


@pytest.fixture(scope="module")
def made() -> Drive:
    return drive(WORLDS["office"](), LASER, 4.0, 4, Wheels())


def poses(outputs) -> list[bytes]:
    return [encode_pose(output, 0).payload for output in outputs]


def places(outputs) -> np.ndarray:
    """(N, 3) m, m, rad."""
    return np.array([(o.pose_map_base.x_m, o.pose_map_base.y_m, o.pose_map_base.theta_rad) for o in outputs])


def test_from_the_event_on_the_other_profile_maps_in_a_map_of_its_own(made, tmp_path):
    event = {"event": "switch_profile", "profile": "contour_lm"}
    done = replay([recorded(tmp_path / "s.mcap", made, event)], ReplayOptions())
    before = [output for output in done.outputs if output.stamp_ns < AT_NS]
    after = [output for output in done.outputs if output.stamp_ns >= AT_NS]
    by_default = replay([recorded(tmp_path / "d.mcap", made, {"event": "mark"})], ReplayOptions()).outputs
    assert poses(before) == poses(by_default[: len(before)])
    np.testing.assert_allclose(places(after[:1]), 0.0, atol=1e-12)
    assert done.summary["profile"] == "contour_lm"
    assert done.summary["profile_switches"] == [{"at_s": 2.0, "profile": "contour_lm"}]
    assert done.summary["map_resets"] == 1
    assert done.graph is None  # of contour_lm no one can begin in it


def test_a_profile_that_is_asked_for_stays(made, tmp_path, caplog):
    event = {"event": "switch_profile", "profile": "contour_lm"}
    session = recorded(tmp_path / "s.mcap", made, event)
    with caplog.at_level(logging.WARNING):
        done = replay([session], ReplayOptions(profile="corridor"))
    assert done.summary["profile"] == "corridor"
    assert "profile_switches" not in done.summary
    assert done.summary["map_resets"] == 1
    assert (
        "2.000 s after its beginning the recording was mapped on with the profile contour_lm" in caplog.text
    )


def test_a_profile_of_another_version_is_named(made, tmp_path):
    session = recorded(tmp_path / "s.mcap", made, {"event": "switch_profile", "profile": "imle2"})
    with pytest.raises(InputError, match=r"2.000 s after its beginning .* imle2 is no profile; .* --profile"):
        replay([session], ReplayOptions())
