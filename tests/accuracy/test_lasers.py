"""Three lasers of which each begins by seeing what the others do not."""

from service.mapper.profiles import build_mapper, mapping_config
from simulators.truth import Ride
from simulators.worlds import WORLDS
from tests.accuracy.lasers import ALL, frames_of

SECONDS, SEED = 2.5, 11  # the others of seeds 11 to 15 went well before, too


def test_who_looks_elsewhere_is_neither_accused_nor_drawn_along_the_corridor() -> None:
    """The LUX ahead has the first scan; the UTM-30LX behind sees 1 % of what it saw, at rest for 0.7 s."""
    ride = Ride(WORLDS["ring"](), 0, 0.5)
    mapper = build_mapper(mapping_config(), {laser.name: laser.mounting for laser in ALL})
    start, mapped = ride.pose(0), 0
    for frame in frames_of(ride, ALL, SECONDS, SEED):
        if (output := mapper.process(frame)) is None:
            continue
        assert "rear" not in output.reason
        off = (start.inverse() @ ride.pose(output.stamp_ns)).inverse() @ output.pose_map_base
        assert abs(off.x_m) < 0.1
        assert abs(off.theta_rad) < 0.01
        mapped += frame.sensor == "rear" and output.state == "ok"
    assert mapped > 50
