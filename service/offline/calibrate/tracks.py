"""The vehicle's motion as each sensor alone measures it: a laser by its own map, the wheels, a gyro."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from drivers.frames import ImuSample, LaserScan, OdometrySample
from service.errors import InputError
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.corrections import corrected
from service.mapper.profiles import build_mapper, mapping_config
from service.outputs import MapperOutput

Stamps = npt.NDArray[np.int64]

MAX_LOST = 0.05  # of a laser's scans that may fit nowhere; with more its motion is not to be trusted
MIN_SCANS = 100
SMALL_RAD = 1e-6  # below it the chord of an arc is its length


def interpolated(at_ns: Stamps | Floats, stamp_ns: Stamps, poses: Floats) -> Floats:
    """(M, 3) poses at some stamps, straight between the (N, 3) at rising stamps."""
    return np.column_stack([np.interp(at_ns, stamp_ns, column) for column in poses.T])


@dataclass(frozen=True, slots=True, eq=False)
class LaserTrack:
    """Path of a laser, by its scans alone."""

    sensor: str
    stamp_ns: Stamps  # (N,), rising: first ray of each scan
    pose: Floats  # (N, 3) pose_map_laser x m, y m, theta rad, theta without jumps by a turn
    latency_ms: Floats  # (N,) from the first ray to the last byte

    def at(self, stamp_ns: Stamps | Floats) -> Floats:
        """(M, 3) poses, straight between scans."""
        return interpolated(stamp_ns, self.stamp_ns, self.pose)


@dataclass(frozen=True, slots=True, eq=False)
class WheelTrack:
    """Odometry as steps from sample to sample."""

    sensor: str
    stamp_ns: Stamps  # (N,), rising
    steps: Floats  # (N - 1, 3) forward m, left m, turn rad: twist times duration
    latency_ms: Floats

    def poses(self, scale: float, turn_scale: float, turn_per_m: float, metres_per_turn: float) -> Floats:
        """(N, 3) of the base, from the origin on; theta is not wrapped.

        true forward = scale * counted forward + metres_per_turn * counted turn
        true turn = turn_scale * counted turn + turn_per_m * counted forward
        """
        forward = scale * self.steps[:, 0] + metres_per_turn * self.steps[:, 2]
        left = scale * self.steps[:, 1]
        turn = turn_scale * self.steps[:, 2] + turn_per_m * self.steps[:, 0]
        theta = np.concatenate(([0.0], np.cumsum(turn)))
        middle = theta[:-1] + 0.5 * turn  # a step along an arc goes along its chord
        half = 0.5 * turn
        chord = np.where(np.abs(half) < SMALL_RAD, 1.0, np.sin(half) / np.where(half == 0.0, 1.0, half))
        c, s = chord * np.cos(middle), chord * np.sin(middle)
        x = np.concatenate(([0.0], np.cumsum(c * forward - s * left)))
        y = np.concatenate(([0.0], np.cumsum(s * forward + c * left)))
        return np.column_stack((x, y, theta))


@dataclass(frozen=True, slots=True, eq=False)
class GyroTrack:
    """The turn that a gyro has added up."""

    stamp_ns: Stamps  # (N,), rising
    turn_rad: Floats  # (N,) about the vertical, trapezoids between samples
    latency_ms: Floats


class LaserMapping:
    """Maps with the scans of one laser and nothing else, as if it were the vehicle."""

    def __init__(self, sensor: str) -> None:
        self._sensor = sensor
        self._mapper = build_mapper(mapping_config(), {sensor: SE2()})
        self._outputs: list[MapperOutput] = []
        self._latency_ms: list[float] = []

    def add(self, scan: LaserScan) -> None:
        if (output := self._mapper.process(scan)) is not None:
            self._outputs.append(output)
            self._latency_ms.append((scan.arrived_ns - scan.stamp_ns) * 1e-6)

    def finish(self) -> LaserTrack:
        """Raises InputError where there are too few scans, or where they do not hold a map by themselves."""
        outputs, sensor = self._outputs, self._sensor
        if len(outputs) < MIN_SCANS:
            raise InputError(
                f"{sensor}: {counted(len(outputs), 'scan')}; expected {MIN_SCANS} or more to calibrate by"
            )
        lost = sum(output.state == "lost" for output in outputs)
        if lost > MAX_LOST * len(outputs):
            raise InputError(
                f"{sensor}: {lost} of {counted(len(outputs), 'scan')} fit nowhere on the map "
                f"that it makes alone (at "
                f"most {MAX_LOST:.0%}); drive where it sees walls in several directions, and slower"
            )
        poses = corrected(outputs, self._mapper.finish().corrections)
        pose = np.array([(p.x_m, p.y_m, p.theta_rad) for p in poses])
        pose[:, 2] = np.unwrap(pose[:, 2])
        stamps = np.array([output.stamp_ns for output in outputs], dtype=np.int64)
        return LaserTrack(sensor, stamps, pose, np.array(self._latency_ms))


def wheel_track(samples: Sequence[OdometrySample]) -> WheelTrack | None:
    """None where there are fewer than two samples."""
    rising = _rising(samples)
    if len(rising) < 2:
        return None
    poses = [SE2(sample.x_m, sample.y_m, sample.theta_rad) for sample in rising]
    steps = [a.between(b).log() for a, b in pairwise(poses)]
    return WheelTrack(rising[0].sensor, _stamps(rising), np.array(steps), _latency_ms(rising))


def gyro_track(samples: Sequence[ImuSample]) -> GyroTrack | None:
    """None where there are fewer than two samples."""
    rising = _rising(samples)
    if len(rising) < 2:
        return None
    stamps = _stamps(rising)
    rate = np.array([sample.rate_radps[2] for sample in rising])
    turn = np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(stamps) * 1e-9)
    return GyroTrack(stamps, np.concatenate(([0.0], turn)), _latency_ms(rising))


Sample = OdometrySample | ImuSample
SampleT = TypeVar("SampleT", OdometrySample, ImuSample)


def _rising(samples: Sequence[SampleT]) -> list[SampleT]:
    rising: list[SampleT] = []
    for sample in samples:
        if not rising or sample.stamp_ns > rising[-1].stamp_ns:
            rising.append(sample)
    return rising


def _stamps(samples: Sequence[Sample]) -> Stamps:
    return np.array([sample.stamp_ns for sample in samples], dtype=np.int64)


def _latency_ms(samples: Sequence[Sample]) -> Floats:
    return np.array([(sample.arrived_ns - sample.stamp_ns) * 1e-6 for sample in samples])
