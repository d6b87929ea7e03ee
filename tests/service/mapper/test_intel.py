"""A scan a second along a corridor: the Intel Research Lab, 6 minutes into the recording."""

import math
from pathlib import Path

import numpy as np
import pytest

from drivers.frames import OdometrySample
from service.geometry.se2 import SE2
from service.mapper.profiles import build_mapper, mapping_config
from tests.recorded_drive import frames_of
from tests.service.mapper.drives import outputs_of

SCANS = 530
FROM_S, TO_S = 380.0, 389.0  # after the first scan: 2.2 m along a corridor whose doors are shut


def test_chance_does_not_shorten_the_motion_along_a_corridor(shared: Path) -> None:
    """Odometry is honest to 5 cm a scan there, and the scans hardly fix the position along the walls."""
    frames = frames_of(shared / "datasets" / "intel" / "intel.mcap", SCANS)
    mapper = build_mapper(mapping_config(), {"scan": SE2()})
    outputs = outputs_of(mapper, frames)
    odometry = [frame for frame in frames if isinstance(frame, OdometrySample)]
    matched = _path_length_m(
        [o.stamp_ns for o in outputs], [(o.pose_odom_base.x_m, o.pose_odom_base.y_m) for o in outputs]
    )
    driven = _path_length_m([o.stamp_ns for o in odometry], [(o.x_m, o.y_m) for o in odometry])
    assert driven > 2.0
    assert matched == pytest.approx(driven, abs=0.35)


def _path_length_m(stamps_ns: list[int], xy_m: list[tuple[float, float]]) -> float:
    time_s = (np.array(stamps_ns) - stamps_ns[0]) * 1e-9
    x_m, y_m = (np.interp([FROM_S, TO_S], time_s, column) for column in np.array(xy_m).T)
    return math.hypot(x_m[1] - x_m[0], y_m[1] - y_m[0])
