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
    ANCHOR 19:22  pose at the anchor of odometry, see ODOMETRY_USED, against the local map
"""

from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from service.compile.lazy import Layout
from service.kernels.tracks import PATH_POSES

MAP, LOCAL, STEP, TWIST, SCALE, TURN_SCALE, LAG, BIAS = 0, 3, 6, 9, 12, 13, 14, 15
ACCELERATION, ANCHOR, STATES = 16, 19, 22
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
    fault_noise: float  # factor on the modelled variance above which odometry is not used


SETTINGS = np.dtype([(name, np.float64) for name in MotionSettings._fields])
INCREMENT = np.dtype(
    [
        ("has_odometry", np.bool_),  # odometry measured the motion
        ("is_extrapolated", np.bool_),  # beyond its newest sample
        ("has_gyro", np.bool_),
        ("step", np.float64, 3),  # by odometry
        ("variance_m2", np.float64),  # by odometry's model, along each axis, without extrapolation
        ("variance_rad2", np.float64),
        ("end_s3", np.float64),  # variance of the extrapolation at its end over the density of [2]; [8]
        ("gyro_rad", np.float64),  # rotation less bias
        ("gyro_rad2", np.float64),  # its variance by the gyro's model
    ],
    align=True,
)
# The anchor is the last scan up to which odometry was used as a measurement: between its samples, it is not.
ODOMETRY_USED = np.dtype(
    [
        ("is_known", np.bool_),
        ("anchor_ns", np.int64),
        ("pose", np.float64, 3),  # of odometry at the anchor
        ("twist", np.float64, 3),  # mean up to there
        ("lag_s", np.float64),  # used for both
        ("since", np.float64, 3),  # motion of the base since the anchor
        ("newest", np.float64, 3),  # pose of odometry at the newest scan, extrapolated or not
    ],
    align=True,
)
WINDOW = np.dtype(
    [
        ("pose", np.float64, 3),  # at its begin
        ("twist", np.float64, 3),
        ("twist_variance", np.float64, 3),
        ("increment", INCREMENT),  # since then; measured: at each step
        ("travel_m", np.float64),  # a radian counts as a metre
        ("elapsed_s", np.float64),
    ],
    align=True,
)
PATH = np.dtype(
    [("stamp_ns", np.int64, PATH_POSES), ("value", np.float64, (PATH_POSES, 3)), ("span", np.int64, 2)]
)
FILTER = np.dtype(
    [
        ("settings", SETTINGS),
        ("stamp_ns", np.int64),  # of the newest pose
        ("pose", np.float64, 3),  # base in odom
        ("twist", np.float64, 3),  # m/s forward, m/s left, rad/s
        ("acceleration", np.float64, 3),  # of the twist
        ("scale", np.float64),  # learnt errors of odometry and gyro
        ("turn_scale", np.float64),
        ("lag_s", np.float64),
        ("bias_radps", np.float64),
        ("covariance", np.float64, (STATES, STATES)),
        ("noise", np.float64, 2),  # learnt factor on odometry's variance: distance, rotation
        ("gyro_noise", np.float64),
        ("motion_noise", np.float64, 3),  # the same of the acceleration; 1 where odometry or gyro measures it
        ("increment", INCREMENT),  # since the last scan
        ("odometry_used", ODOMETRY_USED),  # at the newest pose
        ("window", WINDOW),  # since the noise was learnt last
        ("mean_twist", np.float64, 3),  # of odometry, over the last half second
        ("scale_twist", np.float64, 3),  # that the scale error is multiplied by
        ("path", PATH),  # a Track of the poses at the last scans
    ],
    align=True,
)
# (1,): a kernel takes an array in an eighth of the time of a record
FilterRecord = Annotated[npt.NDArray[np.void], Layout(FILTER, 1)]
