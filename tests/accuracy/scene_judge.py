"""Errors, states and covariances of a mapper during a scene, against the truth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from service.geometry.se2 import SE2
from service.outputs import MapperOutput

Floats = npt.NDArray[np.float64]

WRONG_M = 0.3  # a pose that is farther off must not be `ok`
WITHIN_M, SIGMAS = 0.05, 3.0  # a pose within both needs no `degraded`
NORMED = 3.76  # of three coordinates a distance of so many is as rare as SIGMAS of one
RIGHT_M = 0.1
ALLOWED_PERCENT = 2.0  # of the distance driven, where the remaining sources are good
MAP_NS = 2_000_000_000  # before the fault: the pose in the map then counts as right
MIN_COVARIANCE = np.diag([1e-8, 1e-8, 1e-10])  # the first scan of a map knows its pose without error


@dataclass(frozen=True)
class Verdict:
    """Of one run. A share is of all scans."""

    scans: int
    ok_off: int  # `ok` and farther off than WRONG_M
    ok_beyond: int  # `ok` and off by more than SIGMAS and WITHIN_M
    needless_percent: float  # `degraded` or `lost`, and within SIGMAS and WITHIN_M
    needless_still_percent: float  # the same before and after the fault alone
    lost_percent: float
    worst_m: float
    worst_deg: float  # of the heading
    fault_m: float  # off at the end of the fault
    fault_percent: float  # of the distance driven during it
    end_m: float
    end_percent: float  # of the distance driven since the fault began
    right_after_s: float  # the end of the fault: from then on within RIGHT_M and not lost; inf: never
    ghosts: int  # cells of the map

    @property
    def over_m(self) -> float:
        """Error at the end of the fault beyond ALLOWED_PERCENT of the distance driven during it, m."""
        if math.isnan(self.fault_percent):
            return self.fault_m
        return self.fault_m * (1.0 - ALLOWED_PERCENT / max(self.fault_percent, ALLOWED_PERCENT))

    def line(self) -> str:
        shown = []
        for field in fields(self):
            value = getattr(self, field.name)
            shown.append(f"{field.name}={value}" if isinstance(value, int) else f"{field.name}={value:.2f}")
        return " ".join(shown)


def errors_in_map(outputs: Sequence[MapperOutput], truth: Sequence[SE2], before_ns: int) -> Floats:
    """(N, 3) m forward, m left, rad of each pose, against the true pose in the map of the time before
    before_ns: the mean error of the last MAP_NS before is that of the map. Without scans then, as it is.
    """
    offsets = [
        (output.pose_map_base @ pose.inverse())
        for output, pose in zip(outputs, truth, strict=True)
        if before_ns - MAP_NS <= output.stamp_ns < before_ns
    ]
    of_map = SE2()
    if offsets:
        of_map = SE2.exp(*np.mean([offset.log() for offset in offsets], axis=0).tolist())
    away = [
        (of_map @ pose).inverse() @ output.pose_map_base for output, pose in zip(outputs, truth, strict=True)
    ]
    return np.array([(e.x_m, e.y_m, e.theta_rad) for e in away])


def normed(errors: Floats, outputs: Sequence[MapperOutput]) -> Floats:
    """(N,) each error (3,) in standard deviations of its covariance."""
    return np.array(
        [
            np.sqrt(error @ np.linalg.solve(output.covariance + MIN_COVARIANCE, error))
            for error, output in zip(errors, outputs, strict=True)
        ]
    )


def judge(
    outputs: Sequence[MapperOutput], truth: Sequence[SE2], from_ns: int, to_ns: int, ghosts: int = 0
) -> Verdict:
    """Something is wrong from from_ns to to_ns; truth is where the base was at each output."""
    errors = errors_in_map(outputs, truth, from_ns)
    off_m = np.hypot(errors[:, 0], errors[:, 1])
    stamp_ns = np.array([output.stamp_ns for output in outputs])
    state = np.array([output.state for output in outputs])
    is_ok, is_lost = state == "ok", state == "lost"
    is_within = (off_m <= WITHIN_M) & (normed(errors, outputs) <= NORMED)
    is_beyond = (off_m > WITHIN_M) & (normed(errors, outputs) > NORMED)
    is_fault = (stamp_ns >= from_ns) & (stamp_ns < to_ns)
    path_length_m = np.r_[0.0, np.cumsum([_path_length_m(a, b) for a, b in pairwise(truth)])]
    begun = max(int(np.searchsorted(stamp_ns, from_ns)) - 1, 0)
    over = min(int(np.searchsorted(stamp_ns, to_ns)), len(stamp_ns) - 1)
    since_m = path_length_m - path_length_m[begun]
    return Verdict(
        scans=len(outputs),
        ok_off=int(np.sum(is_ok & (off_m > WRONG_M))),
        ok_beyond=int(np.sum(is_ok & is_beyond)),
        needless_percent=100.0 * float(np.mean(~is_ok & is_within)),
        needless_still_percent=100.0 * float(np.mean(~is_ok & is_within & ~is_fault)),
        lost_percent=100.0 * float(np.mean(is_lost)),
        worst_m=float(off_m.max()),
        worst_deg=math.degrees(float(np.abs(errors[:, 2]).max())),
        fault_m=float(off_m[over]),
        fault_percent=_percent(float(off_m[over]), float(since_m[over])),
        end_m=float(off_m[-1]),
        end_percent=_percent(float(off_m[-1]), float(since_m[-1])),
        right_after_s=_right_after_s(stamp_ns, (off_m <= RIGHT_M) & ~is_lost, to_ns),
        ghosts=ghosts,
    )


def trace(outputs: Sequence[MapperOutput], truth: Sequence[SE2], from_ns: int) -> list[str]:
    """A line for each second: how far off, what the covariance says, the state."""
    errors = errors_in_map(outputs, truth, from_ns)
    lines, next_ns = [], outputs[0].stamp_ns
    first_ns = next_ns
    for output, error, pose in zip(outputs, errors, truth, strict=True):
        if output.stamp_ns < next_ns:
            continue
        next_ns += 1_000_000_000
        sigma_m = math.sqrt(float(np.linalg.eigvalsh(output.covariance[:2, :2])[1]))
        lines.append(
            f"{1e-9 * (output.stamp_ns - first_ns):6.2f} s  off {math.hypot(*error[:2]):7.3f} m"
            f" ({error[0]:+.3f} {error[1]:+.3f} m {math.degrees(error[2]):+.2f} deg)"
            f"  sigma {sigma_m:7.4f} m  true {pose.x_m:7.2f} {pose.y_m:7.2f}"
            f"  inliers {output.inlier_ratio:4.2f}  {output.state:<8} {output.reason}"
        )
    return lines


def _path_length_m(a: SE2, b: SE2) -> float:
    return math.hypot(b.x_m - a.x_m, b.y_m - a.y_m)


def _percent(off_m: float, path_length_m: float) -> float:
    return 100.0 * off_m / path_length_m if path_length_m > 0.0 else math.nan


def _right_after_s(stamp_ns: npt.NDArray[np.int64], is_right: npt.NDArray[np.bool_], to_ns: int) -> float:
    """From to_ns to the first scan from which on all are right."""
    wrong = np.flatnonzero(~is_right)
    first = int(wrong[-1]) + 1 if len(wrong) else 0
    if first == len(stamp_ns):
        return math.inf
    return max(0.0, 1e-9 * float(stamp_ns[first] - to_ns))
