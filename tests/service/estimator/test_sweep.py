"""The motion within a sweep: what odometry and gyro measure of it beyond a constant twist."""

import math

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, LaserScan
from service.estimator.estimator import Estimator, EstimatorConfig
from service.estimator.motion import Motion, Prediction
from service.geometry.se2 import SE2
from service.mapper.filters.deskew import BeamsConfig, DeskewByMotion, DeskewByTwist
from tests.service.estimator.samples import MS, gyro, matched, odometry

SWEEP_MS, BEAMS = 150, 301
AT_MS = 1000  # of the scan; until then the vehicle stands
TURNS_RADPS2, DRIVES_MPS2 = 4.0, 1.0
TIGHT = np.diag([1e-6, 1e-6, 1e-8])


def begun_to_move(stamp_ms: float) -> SE2:
    """Standing, then turning and driving faster and faster."""
    t = max(stamp_ms - AT_MS, 0.0) * 1e-3
    path_m, turn_rad = 0.5 * DRIVES_MPS2 * t * t, 0.5 * TURNS_RADPS2 * t * t
    return SE2.exp(path_m, 0.0, turn_rad)


def predicted(has_odometry: bool = True, has_gyro: bool = False) -> Prediction:
    """At AT_MS, of a model with samples each 10 ms and tight scans each 100 ms."""
    model, motion = Estimator(EstimatorConfig()), begun_to_move
    for stamp_ms in range(0, AT_MS + SWEEP_MS + 21, 10):
        if has_odometry:
            model.add(odometry(stamp_ms, motion(stamp_ms)))
        if has_gyro:
            turned_rad = motion(stamp_ms + 5).theta_rad - motion(stamp_ms - 5).theta_rad
            model.add(gyro(stamp_ms, turned_rad / 0.01))
    for stamp_ms in range(0, AT_MS, 100):
        model.predict(stamp_ms * MS)
        model.correct(matched(motion(0).inverse() @ motion(stamp_ms), TIGHT))
    return model.predict(AT_MS * MS)


def seen_by(motion) -> tuple[LaserScan, np.ndarray]:
    """A scan of a wall 4 m around where it begins, and its points as they are, (N, 2) m."""
    bearing = np.linspace(-2.3, 2.3, BEAMS)
    range_m = np.empty(BEAMS)
    points = np.empty((BEAMS, 2))
    for i, angle in enumerate(bearing):
        base = motion(AT_MS).inverse() @ motion(AT_MS + SWEEP_MS * i / (BEAMS - 1))
        c, s = math.cos(base.theta_rad + angle), math.sin(base.theta_rad + angle)
        ahead = base.x_m * c + base.y_m * s
        range_m[i] = -ahead + math.sqrt(ahead**2 + 16.0 - base.x_m**2 - base.y_m**2)
        points[i] = base.x_m + range_m[i] * c, base.y_m + range_m[i] * s
    scan = LaserScan(
        "front", AT_MS * MS, (AT_MS + SWEEP_MS) * MS, SWEEP_MS * MS // (BEAMS - 1), 200 * MS, -2.3,
        4.6 / (BEAMS - 1), 0.05, 20.0, range_m.astype(np.float32), NO_INTENSITY,
    )  # fmt: skip
    return scan, points


def off_m(prediction: Motion, motion, deskew=DeskewByMotion) -> float:
    """How far the farthest point ends from where it is."""
    scan, points = seen_by(motion)
    found = deskew(BeamsConfig(), {"front": SE2()})(scan, prediction, AT_MS * MS)
    return float(np.hypot(*(found.xy_base - points).T).max())


@pytest.mark.parametrize(
    ("sources", "most_m"),
    [
        ({}, 0.01),
        (
            {"has_odometry": False, "has_gyro": True},
            0.03,
        ),  # the displacement, 11 mm at the end, is unmeasured
    ],
    ids=["odometry", "gyro"],
)
def test_a_turn_that_begins_within_the_sweep_bends_no_wall(sources: dict[str, bool], most_m: float):
    prediction = predicted(**sources)
    assert off_m(prediction, begun_to_move, DeskewByTwist) > 0.15
    assert off_m(prediction, begun_to_move) < most_m


def deviation_of(prediction: Prediction, begin_s: float, end_s: float) -> np.ndarray:
    """(31, 3) m, m, rad: measured deviation from constant twist, by points at the base and 1 m ahead."""
    assert prediction.deskew is not None
    xy_raw = np.tile([[0.0, 0.0], [1.0, 0.0]], (31, 1))
    prediction.deskew(np.repeat(np.linspace(begin_s, end_s, 31), 2), xy_raw, np.empty_like(xy_raw))
    ahead = xy_raw[1::2] - xy_raw[::2]
    return np.column_stack((xy_raw[::2], np.arctan2(ahead[:, 1], ahead[:, 0])))


def test_a_turn_that_goes_on_growing_bends_no_wall_although_no_one_measures_it():
    """Scans each 40 ms have shown the acceleration; the sweep of the next one is expected to have it."""

    def grown(stamp_ms: float) -> SE2:
        return begun_to_move(stamp_ms + 320)

    model = Estimator(EstimatorConfig())
    for stamp_ms in range(0, AT_MS, 40):
        model.predict(stamp_ms * MS)
        model.correct(matched(grown(0).inverse() @ grown(stamp_ms), TIGHT))
    prediction = model.predict(AT_MS * MS)
    assert off_m(prediction, grown, DeskewByTwist) > 0.18
    assert off_m(prediction, grown) < 0.12


def test_without_a_sample_the_scan_is_as_by_the_twist_to_the_last_bit():
    prediction = predicted(has_odometry=False)
    scan, _ = seen_by(begun_to_move)
    kinds = (DeskewByMotion, DeskewByTwist)
    one, other = (kind(BeamsConfig(), {"front": SE2()})(scan, prediction) for kind in kinds)
    np.testing.assert_array_equal(one.xy_base, other.xy_base)
    assert not deviation_of(prediction, 0.0, 0.15).any()


@pytest.mark.parametrize("begin_s", [-0.2, 0.0])
def test_moments_are_even_and_the_first_scan_of_the_sweep_may_lie_before(begin_s: float):
    """Of two lasers the one is brought to the moment of the other."""
    prediction = predicted()
    deviation = deviation_of(prediction, begin_s, begin_s + 0.3)
    moments_s = np.linspace(begin_s, begin_s + 0.3, len(deviation))
    expected_rad = [begun_to_move(AT_MS + 1e3 * t).theta_rad for t in np.minimum(moments_s, 0.17)]
    assert deviation[:, 2] == pytest.approx(expected_rad, abs=6e-3)
