"""Three lasers of which each begins by seeing what the others do not."""

import pytest

from service.mapper.profiles import build_mapper, mapping_config
from simulators.truth import Ride
from simulators.worlds import WORLDS
from tests.accuracy.lasers import ALL, frames_of
from tests.soaked import in_soak

SECONDS = 2.5


@pytest.mark.parametrize("seed", [11, in_soak(31)])
def test_a_laser_on_new_ground_is_neither_named_nor_drawn_along_the_corridor(seed: int) -> None:
    """The LUX ahead has the first scan; the UTM-30LX behind sees 1 % of what it saw, at rest for 0.7 s."""
    ride = Ride(WORLDS["ring"](), 0, 0.5)
    mapper = build_mapper(mapping_config(), {laser.name: laser.mounting for laser in ALL})
    start, mapped = ride.pose(0), 0
    for frame in frames_of(ride, ALL, SECONDS, seed):
        if (output := mapper.process(frame)) is None:
            continue
        assert "rear" not in output.reason
        off = (start.inverse() @ ride.pose(output.stamp_ns)).inverse() @ output.pose_map_base
        assert abs(off.x_m) < 0.1
        assert abs(off.theta_rad) < 0.01
        mapped += frame.sensor == "rear" and output.state == "ok"
    assert mapped > 50
