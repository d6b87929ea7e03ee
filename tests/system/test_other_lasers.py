"""Each model of laser from its fake device through the real driver into the mapper, in virtual time."""

import numpy as np
import pytest

from drivers.registry import SENSOR_KINDS
from service.geometry.se2 import SE2
from service.mapper.profiles import build_mapper, mapping_config
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from simulators.truth import LMS500, TIM500, URG04LX, UST, LaserTruth, Ride
from simulators.worlds import build_world
from tests.drivers.virtual_time import SECOND_NS, Talk

BEGIN_NS = 1_000 * SECOND_NS
RUN_S = 9.0  # the last 5 s of it driven, through the office
FORWARD = SE2(0.2, 0.0, 0.0)
SICK, HOKUYO = "sick_lms100", "hokuyo_utm30lx"


@pytest.mark.parametrize(
    ("kind", "optics", "device", "setup", "settings", "most_m"),
    [
        (SICK, LMS500, FakeLms100, Lms100Setup("lms5xx"), {"model": "lms5xx", "host": "h"}, 0.01),
        (SICK, TIM500, FakeLms100, Lms100Setup("tim5xx"), {"model": "tim5xx", "host": "h"}, 0.02),
        (HOKUYO, UST, FakeUtm30lx, Utm30lxSetup("ethernet", "ust"), {"model": "ust", "host": "h"}, 0.01),
        (
            HOKUYO,
            URG04LX,
            FakeUtm30lx,
            Utm30lxSetup("usb", "urg_04lx_ug01"),
            {"model": "urg_04lx_ug01", "device": "d"},
            0.03,
        ),
    ],
    ids=["LMS5xx", "TiM5xx", "UST", "URG-04LX-UG01"],
)
def test_office_is_mapped_with_each_model(kind, optics, device, setup, settings, most_m):
    ride = Ride(build_world("office"), BEGIN_NS, stand_s=4.0)
    sensor = SENSOR_KINDS[kind]
    session = sensor.session_maker(sensor.config(name="front", **settings))()
    talk = Talk(session, device(LaserTruth(ride, "front", FORWARD, optics, seed=11), setup), BEGIN_NS)
    talk.connect().run(RUN_S)
    assert session.status == "streaming"
    mapper = build_mapper(mapping_config(), {"front": FORWARD})
    outputs = [output for frame in talk.frames if (output := mapper.process(frame)) is not None]
    assert len(outputs) > 0.5 * len(talk.frames)
    first = ride.pose(outputs[0].stamp_ns)
    away = [
        (first.inverse() @ ride.pose(output.stamp_ns)).inverse() @ output.pose_map_base for output in outputs
    ]
    worst_m = max(np.hypot(error.x_m, error.y_m) for error in away)
    assert np.hypot(outputs[-1].pose_map_base.x_m, outputs[-1].pose_map_base.y_m) > 2.0
    assert worst_m < most_m
