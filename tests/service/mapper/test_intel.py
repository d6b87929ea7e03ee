"""A scan a second along a corridor: the Intel Research Lab, at the start and after 6 minutes."""

import math
from pathlib import Path

import numpy as np
import pytest

from drivers.frames import LaserScan, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.profiles import build_mapper, mapping_config
from tests.recorded_drive import frames_of
from tests.service.mapper.drives import outputs_of

SCANS = 530
BEGIN_S = 330.0  # after the first scan; what comes before is left out
FROM_S, TO_S = 380.0, 389.0  # 2.2 m along a corridor whose doors are shut


def test_chance_does_not_shorten_the_motion_along_a_corridor(shared: Path) -> None:
    """Odometry is correct to 5 cm a scan there, and the scans hardly fix the position along the walls."""
    frames = frames_of(shared / "datasets" / "intel" / "intel.mcap", SCANS)
    first_ns = next(frame.stamp_ns for frame in frames if isinstance(frame, LaserScan))
    frames = [frame for frame in frames if frame.stamp_ns > first_ns + BEGIN_S * 1e9]
    mapper = build_mapper(mapping_config(), {"scan": SE2()})
    outputs = outputs_of(mapper, frames)
    odometry = [frame for frame in frames if isinstance(frame, OdometrySample)]
    matched = _path_length_m([(o.stamp_ns - first_ns, *o.pose_odom_base[:2]) for o in outputs])
    driven = _path_length_m([(o.stamp_ns - first_ns, o.x_m, o.y_m) for o in odometry])
    assert driven > 2.0
    assert matched == pytest.approx(driven, abs=0.35)


def test_a_vehicle_that_is_switched_on_in_a_corridor_knows_its_place_once_it_drives(shared: Path) -> None:
    """It stands for 28 s; the scans do not fix the position along the walls, and odometry has not moved."""
    frames = frames_of(shared / "datasets" / "intel" / "intel.mcap", 36)
    outputs = outputs_of(build_mapper(mapping_config(), {"scan": SE2()}), frames)
    standing, driving = outputs[5:28], outputs[29:33]
    assert max(math.hypot(*output.pose_map_base[:2]) for output in standing) < 0.05
    open_direction = [output for output in standing if output.state == "degraded"]
    assert len(open_direction) > len(standing) // 2
    assert any("Odometry has not moved yet" in output.reason for output in open_direction)
    assert max(math.sqrt(np.linalg.eigvalsh(output.covariance[:2, :2])[1]) for output in driving) < 0.1


def _path_length_m(rows: list[tuple[int, float, float]]) -> float:
    """From FROM_S to TO_S. rows: ns, m, m."""
    stamps_ns, *columns = np.array(rows).T
    x_m, y_m = (np.interp([FROM_S, TO_S], stamps_ns * 1e-9, column) for column in columns)
    return math.hypot(x_m[1] - x_m[0], y_m[1] - y_m[0])
