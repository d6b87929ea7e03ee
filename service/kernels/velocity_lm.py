"""Levenberg-Marquardt on a likelihood map that also estimates the velocity: each step deskews again."""

import math

from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.deskew import Returns, deskew_points
from service.kernels.likelihood import LikelihoodField
from service.kernels.likelihood_lm import LmSettings, align_points
from service.kernels.pose_information import wrap


@inner_kernel
def log_motion(dx, dy, turn, motion):
    """Twist times duration that reaches the pose (dx, dy, turn) in the frame of the start.

    motion   (3,) float64   out: m forward, m left, rad
    Source: logarithm of SE(2) in closed form; Li et al. 2016, eq. 11.
    """
    half = 0.5 * turn
    k = 1.0 - half * half / 3.0 if abs(half) < 1e-4 else half / math.tan(half)
    motion[0] = k * dx + half * dy
    motion[1] = -half * dx + k * dy
    motion[2] = turn


@inner_kernel
def velocity_between(start, pose, elapsed_s, twist):
    """Constant body twist from one pose to the next.

    start, pose   (3,) float64   m, m, rad in one frame
    elapsed_s     float          > 0
    twist         (3,) float64   out: m/s forward, m/s left, rad/s
    Source: Li et al. 2016, eq. 11: V = log(T_{t-1}^-1 T_t) / dt.
    """
    c = math.cos(start[2])
    s = math.sin(start[2])
    x = pose[0] - start[0]
    y = pose[1] - start[1]
    log_motion(c * x + s * y, -s * x + c * y, wrap(pose[2] - start[2]), twist)
    for k in range(3):
        twist[k] /= elapsed_s


@kernel(
    Returns,
    Float64_1D,
    Float64_1D,
    Float64_2D,
    Float64_1D,
    float,
    float,
    LikelihoodField,
    LmSettings,
    int,
    Float64_2D,
    Float64_1D,
    Float64_1D,
    Float64_2D,
)
def align_level(
    returns, weights, prior_pose, prior_information, start, elapsed_s, twist_gain,
    field, settings, most_steps, xy_base, pose, twist, H,
):  # fmt: skip
    """Pose and velocity of a scan on one level of a likelihood map.

    returns             Returns           end points at their own times
    weights             (N,)   float64    from balance_weights, over the variance of 1 - P
    prior_pose          (3,)   float64    predicted
    prior_information   (3, 3) float64    in map axes; all zero: none
    start               (3,)   float64    pose of the previous scan
    elapsed_s           float             since then; 0: the velocity is unchanged
    twist_gain          float             share of a change of the twist that is applied; 1: eq. 11
    field               LikelihoodField   the level
    settings            LmSettings
    most_steps          int               I_max
    xy_base             (N, 2) float64    in: deskewed with twist; out: with the estimated twist
    pose                (3,)   float64    in: initial; out: final
    twist               (3,)   float64    in and out: m/s forward, m/s left, rad/s
    H                   (3, 3) float64    out: Hessian of the points alone, where the last step began
    Source: Li et al. 2016, algorithm 1: one damped step, new velocity, deskew again, until the step is small.
    """
    damping = settings.first_damping
    before = twist.copy()
    for _ in range(most_steps):
        steps, is_settled, damping = align_points(
            xy_base, weights, prior_pose, prior_information, field, settings, 1, damping, pose, H
        )
        if steps == 0:
            break
        if elapsed_s > 0.0:
            velocity_between(start, pose, elapsed_s, twist)
            for k in range(3):
                twist[k] = before[k] + twist_gain * (twist[k] - before[k])
            deskew_points(returns.xy_raw, returns.beam_time_s, twist, xy_base)
        if is_settled:
            break
    pose[2] = wrap(pose[2])
