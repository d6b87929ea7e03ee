import math

from service.geometry.geo_reference import GeoReference, LocalFrame
from service.geometry.se2 import SE2
from service.runtime.gnss_health import GnssHealth

REFERENCE = GeoReference(
    LocalFrame(60.1, 24.5, 51.0), SE2(0.0, 0.0, math.radians(30.0)), 0.84, math.radians(0.31), 62
)


def test_the_state_is_reported_before_and_after_the_map_is_referenced():
    health = GnssHealth()
    before = health.status({"fixes_taken": 3}, None, 0)
    assert before is not None
    assert before.message.startswith("not referenced yet")
    assert before.values["referenced"] == "false"
    after = health.status({"fixes_taken": 9}, REFERENCE, 1)
    assert after is not None
    assert (after.level, after.message) == (0, "referenced to 0.8 m and 0.3 deg by 62 fixes")
    assert after.values["yaw_sigma_deg"] == "0.31"
    assert after.values["map_yaw_enu_deg"] == "30.00"


def test_a_fault_of_the_map_before_is_forgotten_when_another_is_loaded():
    """Its graph counts again, and does not know the counter yet."""
    health = GnssHealth()
    health.status({"fixes_taken": 3, "fixes_out_of_order": 5}, REFERENCE, 0)
    loaded = health.status({"fixes_taken": 1}, None, 1)
    assert loaded is not None
    assert (loaded.level, "stamps do not rise" in loaded.message) == (0, False)
