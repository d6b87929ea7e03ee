"""Scan to points: unusable beams are dropped, the motion during the sweep is removed."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

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


class _Beams(NamedTuple):
    """What the scans of one sensor have in common.

    offset      as of DeskewByTwist.__call__
    mounting    with the offset
    direction   (N, 2) unit vector of each beam, base axes
    xy_m        (2,) the sensor in the base frame
    gate_m      (2,) nearest and farthest range that is used
    """

    offset: SE2 | None
    mounting: SE2
    direction: Floats
    xy_m: Floats
    gate_m: Floats


class DeskewByTwist:
    """Deskewing by constant twist.

    outline_m   corners of the vehicle, base frame: returns inside it are dropped
    """

    def __init__(
        self, config: BeamsConfig, mountings: Mapping[str, SE2], outline_m: Sequence[tuple[float, float]] = ()
    ) -> None:
        self._config = config
        self._outline_m = np.array(outline_m, np.float64).reshape(-1, 2)
        self._mountings = dict(mountings)
        self._noise: dict[str, tuple[int, float]] = {}  # scans, and their mean range noise, m
        self._beams: dict[tuple[str, float, float, float, float, int], _Beams] = {}

    def moment_of(self, scan: LaserScan) -> int:
        """Time of the deskewed points: that of the first beam."""
        return scan.stamp_ns

    def __call__(
        self, scan: LaserScan, motion: Motion, at_ns: int | None = None, offset: SE2 | None = None
    ) -> Points:
        """Points at the time at_ns of the motion; None: that of the first beam. Raises InputError.

        offset   of the laser from its configured mounting, base axes
        """
        range_m, nearest_m, farthest_m = scan.range_m, scan.range_min_m, scan.range_max_m
        beam_count = len(range_m)
        key = scan.sensor, scan.first_angle_rad, scan.angle_step_rad, nearest_m, farthest_m, beam_count
        beams = self._beams.get(key)
        if beams is None or beams.offset != offset:
            beams = self._beams[key] = self._beams_of(scan, offset)
        returns = Returns(np.empty((beam_count, 2)), np.empty(beam_count), np.empty(beam_count, np.int32))
        interval_s = scan.beam_interval_ns * 1e-9
        late_s = 0.0 if at_ns is None else (at_ns - scan.stamp_ns) * 1e-9
        count, noise_m, gap = project_returns(
            range_m, beams.direction, beams.xy_m, beams.gate_m, self._outline_m, interval_s, late_s, returns
        )
        xy_raw, beam_time_s, beam = returns.xy_raw[:count], returns.beam_time_s[:count], returns.beam[:count]
        scans, sigma_m = self._noise.get(scan.sensor, (0, UNKNOWN_NOISE_M))
        if noise_m > 0.0:
            scans = min(scans + 1, NOISE_SCANS)
            sigma_m += (max(noise_m, MIN_NOISE_M) - sigma_m) / scans
            self._noise[scan.sensor] = scans, sigma_m
        xy_base = np.empty((count, 2))
        self._deskew(beam_time_s, xy_raw, motion, xy_base)
        return Points(xy_base, xy_raw, beam_time_s, beam, beams.mounting, scan, sigma_m, gap)

    def _deskew(self, beam_time_s: Floats, xy_raw: Floats, motion: Motion, xy_base: Floats) -> None:
        deskew_points(xy_raw, beam_time_s, np.array(motion.twist_base), xy_base)

    def _beams_of(self, scan: LaserScan, offset: SE2 | None) -> _Beams:
        mounting = self._mountings.get(scan.sensor)
        if mounting is None:
            known = ", ".join(sorted(self._mountings)) or "none"
            raise InputError(
                f"{scan.sensor}: a scan of a laser whose mounting is not known (known: {known}); "
                "give its mounting in the config, or its transform in the recording"
            )
        if offset is not None:
            mounting = offset @ mounting
        x_m, y_m, theta_rad = mounting
        angle = theta_rad + scan.first_angle_rad + np.arange(len(scan.range_m)) * scan.angle_step_rad
        direction = np.ascontiguousarray(np.stack([np.cos(angle), np.sin(angle)], axis=1))
        nearest_m = max(scan.range_min_m, self._config.nearest_m)
        farthest_m = min(scan.range_max_m, self._config.farthest_m)
        return _Beams(offset, mounting, direction, np.array([x_m, y_m]), np.array([nearest_m, farthest_m]))


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
