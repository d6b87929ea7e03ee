"""Scan to points: unusable beams are dropped, the motion during the sweep is removed."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.frames import LaserScan
from drivers.section import Section
from service.errors import InputError
from service.estimator.motion import Motion, Prediction
from service.geometry.se2 import SE2
from service.kernels.deskew import Returns, deskew_points, project_returns
from service.mapper.components import Points

Floats = npt.NDArray[np.float64]

NOISE_SCANS = 100  # over which the range noise of a laser is averaged
MIN_NOISE_M = 0.003  # of a range: no supported laser is better
UNKNOWN_NOISE_M = 0.03  # of a range, before it is measured


class BeamsConfig(Section):
    """Range limits of used returns, besides those of the sensor."""

    nearest_m: float = Field(default=0.10, ge=0.0)  # nearer: error codes of some devices, dirt on the window
    farthest_m: float = Field(default=100.0, gt=0.0)


class DeskewByTwist:
    """Deskewing by constant twist; caches the beam directions of each sensor.

    outline_m   corners of the vehicle, base frame: returns inside it are dropped
    """

    def __init__(
        self, config: BeamsConfig, mountings: Mapping[str, SE2], outline_m: Sequence[tuple[float, float]] = ()
    ) -> None:
        self._config = config
        self._outline_m = np.array(outline_m, np.float64).reshape(-1, 2)
        self._mountings = dict(mountings)
        self._noise: dict[str, tuple[int, float]] = {}
        self._directions: dict[tuple[str, float, float, int], tuple[float, Floats]] = {}

    def moment_of(self, scan: LaserScan) -> int:
        """Time of the deskewed points: that of the first beam."""
        return scan.stamp_ns

    def __call__(
        self, scan: LaserScan, motion: Motion, at_ns: int | None = None, offset: SE2 | None = None
    ) -> Points:
        """Points at the time at_ns of the motion; None: that of the first beam. Raises InputError.

        offset   of the laser from its configured mounting, base axes
        """
        mounting = self._mountings.get(scan.sensor)
        if mounting is None:
            known = ", ".join(sorted(self._mountings)) or "none"
            raise InputError(
                f"{scan.sensor}: a scan of a laser whose mounting is not known (known: {known}); "
                "give its mounting in the config, or its transform in the recording"
            )
        if offset is not None:
            mounting = offset @ mounting
        beam_count = len(scan.range_m)
        returns = Returns(np.empty((beam_count, 2)), np.empty(beam_count), np.empty(beam_count, np.int32))
        config = self._config
        count, noise_m, gap = project_returns(
            scan.range_m,
            self._directions_of(scan, mounting),
            np.array([mounting.x_m, mounting.y_m]),
            np.array([max(scan.range_min_m, config.nearest_m), min(scan.range_max_m, config.farthest_m)]),
            self._outline_m,
            scan.beam_interval_ns * 1e-9,
            0.0 if at_ns is None else (at_ns - scan.stamp_ns) * 1e-9,
            returns,
        )
        xy_raw, beam_time_s, beam = returns.xy_raw[:count], returns.beam_time_s[:count], returns.beam[:count]
        sigma_m = self._noise_of(scan.sensor, noise_m)
        xy_base = np.empty((count, 2))
        self._deskew(beam_time_s, xy_raw, motion, xy_base)
        return Points(xy_base, xy_raw, beam_time_s, beam, mounting, scan, sigma_m, gap)

    def _deskew(self, beam_time_s: Floats, xy_raw: Floats, motion: Motion, xy_base: Floats) -> None:
        deskew_points(xy_raw, beam_time_s, np.array(motion.twist_base), xy_base)

    def _noise_of(self, sensor: str, shown_m: float) -> float:
        """Mean range noise over at most the newest NOISE_SCANS scans."""
        count, mean_m = self._noise.get(sensor, (0, UNKNOWN_NOISE_M))
        if shown_m > 0.0:
            count = min(count + 1, NOISE_SCANS)
            mean_m += (max(shown_m, MIN_NOISE_M) - mean_m) / count
            self._noise[sensor] = count, mean_m
        return mean_m

    def _directions_of(self, scan: LaserScan, mounting: SE2) -> Floats:
        key = (scan.sensor, scan.first_angle_rad, scan.angle_step_rad, len(scan.range_m))
        theta_rad, directions = self._directions.get(key, (math.nan, np.empty((0, 2))))
        if theta_rad != mounting.theta_rad:
            angle = mounting.theta_rad + scan.first_angle_rad + np.arange(key[3]) * scan.angle_step_rad
            directions = np.ascontiguousarray(np.stack([np.cos(angle), np.sin(angle)], axis=1))
            self._directions[key] = mounting.theta_rad, directions
        return directions


class DeskewByMotion(DeskewByTwist):
    """Deskewing by the twist and the measured motion during the sweep; [23]."""

    def moment_of(self, scan: LaserScan) -> int:
        """The middle of the sweep: an error of the twist then rotates its halves against each other instead
        of displacing the scan.
        """
        return scan.stamp_ns + scan.beam_interval_ns * (len(scan.range_m) - 1) // 2

    def _deskew(self, beam_time_s: Floats, xy_raw: Floats, motion: Motion, xy_base: Floats) -> None:
        if isinstance(motion, Prediction) and motion.deskew is not None:
            motion.deskew(beam_time_s, xy_raw, xy_base)
        else:
            super()._deskew(beam_time_s, xy_raw, motion, xy_base)
