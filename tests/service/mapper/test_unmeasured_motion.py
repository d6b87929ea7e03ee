"""All devices are silent for 5 s while the vehicle is driven on, or lifted and carried."""

import numpy as np
import pytest

from service.mapper.localisation import UNCONFIRMED_PLACE
from service.mapper.profiles import MappingConfig, build_mapper, mapping_config
from simulators.worlds import WORLDS
from tests.accuracy.scene_drives import Case, staged
from tests.accuracy.scene_judge import judge
from tests.accuracy.scenes import mapped
from tests.accuracy.sensors import LMS100_10HZ
from tests.carried import carried_back, carried_on, silent
from tests.service.mapper.offices import LASER, outputs_at_once, through
from tests.simulated import FORWARD, Drive, Wheels, drives
from tests.soaked import in_soak

PAUSE_NS = 5_000_000_000
S = 1_000_000_000


def states_after(
    made: Drive, at_ns: int, config: MappingConfig | None = None
) -> tuple[list[str], np.ndarray, np.ndarray, list[str]]:
    """State, m off, s since the pause and reason of each pose after it."""
    mapper = build_mapper(config or mapping_config(), {"front": FORWARD})
    outputs = [output for output in outputs_at_once(mapper, made.frames) if output.stamp_ns > at_ns]
    away = [made.truth[output.stamp_ns].inverse() @ output.pose_map_base for output in outputs]
    return (
        [output.state for output in outputs],
        np.array([np.hypot(pose.x_m, pose.y_m) for pose in away]),
        np.array([(output.stamp_ns - at_ns - PAUSE_NS) / S for output in outputs]),
        [output.reason for output in outputs],
    )


@pytest.mark.parametrize(("world", "at_s"), [("office", 10), in_soak("library", 22)])
def test_after_driving_on_the_place_is_found_by_odometry_on_partly_known_ground(world, at_s):
    made = silent(through(world, at_s + 6.5, 2), at_s * S, PAUSE_NS)
    states, off_m, since_s, reasons = states_after(made, at_s * S)
    assert states[0] == "lost"
    assert reasons[0].startswith("neither laser nor odometry measured the motion for 5.0 s")
    found = states.index("ok")
    assert since_s[found] < 0.5
    assert off_m[found:].max() < 0.05


@pytest.mark.parametrize(("world", "at_s"), [("office", 10), in_soak("library", 22)])
def test_a_vehicle_carried_to_similar_walls_is_never_ok_at_a_wrong_place(world, at_s):
    made = carried_on(through(world, at_s + 5.8, 2), at_s * S, PAUSE_NS)
    states, off_m, _, reasons = states_after(made, at_s * S)
    assert off_m[0] > 3.0
    assert "the vehicle may have been carried" in reasons[0]
    assert not any(state != "lost" and off > 0.3 for state, off in zip(states, off_m, strict=True))


def test_a_corridor_that_looks_like_another_is_not_taken_for_it_where_dead_reckoning_leads_there():
    """The four of a ring look alike: one that is mapped, and the next one, where the vehicle is."""
    of = staged(Case("lifted", "ring", 5, 0.53, 2.0, laser=LMS100_10HZ), after_s=7.0)
    outputs = mapped(of).outputs
    verdict = judge(outputs, [of.made.truth[output.stamp_ns] for output in outputs], of.from_ns, of.to_ns)
    assert verdict.ok_off == 0


def test_a_vehicle_carried_back_is_localised_and_ok_once_confirmed():
    made, again = drives(WORLDS["office"](), LASER, 22.0, [2, 3], Wheels())
    carried = carried_back(made, again, 22 * S, PAUSE_NS, 14 * S, 6 * S)
    states, off_m, since_s, reasons = states_after(carried, 22 * S)
    assert states[0] == "lost"
    found, confirmed = states.index("degraded"), states.index("ok")
    assert since_s[found] < 1.0
    assert reasons[found] == UNCONFIRMED_PLACE
    assert set(states[found:confirmed]) == {"degraded"}
    assert since_s[confirmed] > 3.0  # 4 m at 1 m/s
    assert off_m[found:].max() < 0.05


@pytest.fixture(scope="module")
def driven_on() -> Drive:
    return silent(through("library", 27.8, 2), 22 * S, PAUSE_NS)


def test_without_a_searching_graph_the_map_is_matched_at_once(driven_on: Drive):
    states, off_m, since_s, _ = states_after(
        driven_on, 22 * S, mapping_config({"components": {"graph": "no_graph"}})
    )
    assert "lost" not in states
    assert since_s[0] < 0.2
    assert off_m.max() < 0.05
