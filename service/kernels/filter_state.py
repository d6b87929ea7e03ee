"""State of the error-state filter of the vehicle's motion; equations: service/kernels/estimator.py.

Errors are in base axes of the newest pose: true pose = pose * exp(error). Rows of the covariance:

    MAP    0:3    pose against the first scan
    LOCAL  3:6    pose against the local map, which was built from earlier poses
    STEP   6:9    motion since the last scan; used within a prediction only
    TWIST  9:12   velocity
    SCALE 12, TURN_SCALE 13   of odometry: true distance = (1 + scale) * measured distance
    LAG   14      of odometry's stamps behind the scans', s
    BIAS  15      of the gyro, rad/s
    ACCELERATION 16:19   of the twist
"""

from typing import NamedTuple

from service.kernels.arrays import Float64_1D, Float64_2D, Int64_1D
from service.kernels.compiled import inner_kernel
from service.kernels.tracks import PATH_POSES, Track

MAP, LOCAL, STEP, TWIST, SCALE, TURN_SCALE, LAG, BIAS = 0, 3, 6, 9, 12, 13, 14, 15
ACCELERATION, STATES = 16, 19
STUDENT = 5.0  # degrees of freedom of the prediction's error, Student's t; [12]
MAP_BLOCK, LOCAL_BLOCK = slice(MAP, MAP + 3), slice(LOCAL, LOCAL + 3)


class MotionSettings(NamedTuple):
    """Documented where they are configured."""

    position_walk: float  # m / sqrt(m)
    heading_walk: float  # rad / sqrt(m)
    turn_walk: float  # rad / sqrt(rad)
    resolution_m: float
    resolution_rad: float
    gyro_walk: float  # rad / sqrt(s)
    acceleration: float  # m/s^2 sqrt(s)
    turn_acceleration: float  # rad/s^2 sqrt(s)
    acceleration_s: float  # time constant of an acceleration
    jitter_s: float
    speed_window_s: float
    fault_noise: float  # factor on the modelled variance above which odometry is not used


class Filter(NamedTuple):
    """State and covariance; all arrays are changed in place.

    stamp_ns    (1,)     int64     of the newest pose
    pose        (3,)     float64   base in odom
    twist       (3,)     float64   m/s forward, m/s left, rad/s
    acceleration (3,)    float64   of the twist
    learnt      (4,)     float64   scale, turn scale, lag s, gyro bias rad/s
    covariance  (19, 19) float64
    noise       (2,)     float64   learnt factor on odometry's variance: position, heading
    gyro_noise  (1,)     float64   the same of the gyro
    motion_noise (3,)    float64   the same of the acceleration, forward, left, rotation: 1 where odometry or
                                   gyro measures the motion
    increments  (8,)     float64   odometry's increment (3), whether there was one, its variances (2); the
                                   gyro's rotation less bias, its variance (0: none)
    last_odom   (8,)     float64   odometry at the newest pose: pose (3), mean speed up to then (3), lag in s
                                   used for both, whether there was one
    window      (20,)    float64   since the noise was learnt last: pose then (3); odometry's step (3), its
                                   variances (2), whether it was complete; the gyro's rotation, its variance,
                                   whether it was complete; path length in m, time in s; twist then (3), its
                                   variances (3)
    mean_twist  (3,)     float64   of odometry, over the last half second
    scale_twist (3,)     float64   that the scale error is multiplied by
    path        Track              poses at the last scans
    """

    stamp_ns: Int64_1D
    pose: Float64_1D
    twist: Float64_1D
    acceleration: Float64_1D
    learnt: Float64_1D
    covariance: Float64_2D
    noise: Float64_1D
    gyro_noise: Float64_1D
    motion_noise: Float64_1D
    increments: Float64_1D
    last_odom: Float64_1D
    window: Float64_1D
    mean_twist: Float64_1D
    scale_twist: Float64_1D
    path: Track


class PackedFilter(NamedTuple):
    """A Filter in two arrays, to pass it to a kernel: each array passed takes 0.15 us.

    numbers   (NUMBERS,) float64   the covariance last
    stamps    (STAMPS,)  int64
    """

    numbers: Float64_1D
    stamps: Int64_1D


# Offsets in `numbers`; the poses of the path and the covariance follow.
_POSE, _TWIST, _ACCELERATION, _LEARNT, _NOISE, _GYRO_NOISE, _MOTION_NOISE = 0, 3, 6, 9, 13, 15, 16
_INCREMENTS, _LAST_ODOM, _WINDOW, _MEAN_TWIST, _SCALE_TWIST, _PATH = 19, 27, 35, 55, 58, 61
COVARIANCE = _PATH + 3 * PATH_POSES
NUMBERS, STAMPS = COVARIANCE + STATES * STATES, 3 + PATH_POSES


def views_of(packed):
    """The Filter whose arrays are views into a PackedFilter."""
    numbers, stamps = packed
    return Filter(
        stamps[:1],
        numbers[_POSE:_TWIST],
        numbers[_TWIST:_ACCELERATION],
        numbers[_ACCELERATION:_LEARNT],
        numbers[_LEARNT:_NOISE],
        numbers[COVARIANCE:].reshape((STATES, STATES)),
        numbers[_NOISE:_GYRO_NOISE],
        numbers[_GYRO_NOISE:_MOTION_NOISE],
        numbers[_MOTION_NOISE:_INCREMENTS],
        numbers[_INCREMENTS:_LAST_ODOM],
        numbers[_LAST_ODOM:_WINDOW],
        numbers[_WINDOW:_MEAN_TWIST],
        numbers[_MEAN_TWIST:_SCALE_TWIST],
        numbers[_SCALE_TWIST:_PATH],
        Track(stamps[3:], numbers[_PATH:COVARIANCE].reshape((PATH_POSES, 3)), stamps[1:3]),
    )


filter_in = inner_kernel(views_of)
