"""Four layers into one planar scan. Arrays in, arrays out.

Which points count: those of the layers chosen, without the labels to be left out, within the range limits,
and, where the mounting height is known, above the ground. A label is used only where the scan's flag
indicates that this labelling ran: in real scans the bits of the others are set at random.

Of the echoes of one shot one is chosen. Its end point is projected into the horizontal plane: range times
cosine of the elevation, under the mounting's pitch and roll. It then belongs to the beam of the grid that
its horizontal angle is nearest to; of several points one is chosen:

    horizon   that of the layer that points nearest to the horizon, of equals the nearest range
    nearest   the nearest range
    median    the median range, of an even number the lower

So each beam is one measured point, never a mixture. The grid is the same in every scan: multiples of the step
from the start angle down to the end angle, or to those of the config where the scan reaches beyond them.

Elevations: Ibeo SDK 6.0.4, ScanImporter2202.cpp; of the tilted mirror of eight-layer units:
SICKAG/libsick_ldmrs, ScanPoint and LuxBase (getVAngleOfLayer).
"""

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.frames import no_distance
from drivers.ibeo_lux.config import IbeoLuxConfig
from drivers.ibeo_lux.messages import LABELS, TICKS_PER_DEG, Scan, ScanFlag, ScannerStatus

LAYER_COUNT = 4
ECHO_COUNT = 3
LAYER_STEP_RAD = math.radians(0.8)
_FREE = np.iinfo(np.int64).max
_INDEX_MASK = 0xFFFF

Floats = npt.NDArray[np.floating[Any]]
Integers = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Beams:
    """A planar scan: beam i looks at first_ticks - i * step_ticks."""

    first_ticks: int
    step_ticks: int
    range_m: npt.NDArray[np.float32]  # (N,) horizontal; NaN: nothing that counts, with the label as its cause
    width_cm: npt.NDArray[np.float32]  # (N,) of the echo's pulse, 0 where there is none


def elevation_rad(
    layer: Integers, azimuth_rad: Floats, beam_tilt_rad: float = 0.0, rear: bool = False
) -> Floats:
    """(N,) upwards, against the sensor's own plane. `rear` matters only where the mirror is tilted."""
    elevation: Floats = (layer - 1.5) * LAYER_STEP_RAD
    if beam_tilt_rad:
        bend = beam_tilt_rad * math.sqrt(2.0) * np.sin(azimuth_rad / 2.0 - math.pi / 4.0)
        elevation += -bend if rear else bend
    return elevation


def sound_points(scan: Scan) -> npt.NDArray[np.bool_]:
    """(N,) which points have a layer, an echo and an angle that can be in this scan."""
    layer, echo = scan.points["layer_echo"] & 0x0F, scan.points["layer_echo"] >> 4
    angle_ticks = scan.points["angle_ticks"]
    sound: npt.NDArray[np.bool_] = (layer < LAYER_COUNT) & (echo < ECHO_COUNT)
    sound &= (angle_ticks <= scan.start_ticks) & (angle_ticks >= scan.end_ticks)
    return sound


class LayerReduction:
    """Reduces scans as configured; counts what it leaves out in `counters`."""

    def __init__(self, config: IbeoLuxConfig, counters: Counter[str]) -> None:
        self.beam_tilt_rad = 0.0  # of the device, not 0 on eight-layer units
        self.upside_down = False  # as set in the device
        self._config = config
        self._counters = counters
        self._step_ticks = round(config.angle_step_deg * TICKS_PER_DEG)
        self._is_tilted = config.pitch_deg != 0.0 or config.roll_deg != 0.0
        self._wanted_layer = np.isin(np.arange(16), config.layers)
        self._range_limits_cm = (config.range_min_m * 100.0, config.range_max_m * 100.0)

    def reduce(self, scan: Scan) -> Beams:
        """`scan` must sweep from a larger to a smaller angle, and `sees` some of the configured ones."""
        step = self._step_ticks
        start_ticks, end_ticks = self._sector_ticks(scan)
        first_ticks = -(-start_ticks // step) * step
        beam_count = (first_ticks - end_ticks + step - 1) // step + 1
        beams = Beams(
            first_ticks, step, np.full(beam_count, np.nan, np.float32), np.zeros(beam_count, np.float32)
        )
        usable, labels = self._usable(scan)
        for name, labelled in labels.items():  # the beams that see something else are written over
            behind = (first_ticks - scan.points["angle_ticks"][labelled].astype(np.int64) + step // 2) // step
            beams.range_m[behind] = no_distance(name)
        points = scan.points[usable]
        if len(points) == 0:
            return beams
        layer = (points["layer_echo"] & 0x0F).astype(np.int64)
        angle_ticks = points["angle_ticks"].astype(np.int64)
        azimuth_rad = angle_ticks * (2.0 * math.pi / scan.ticks_per_turn)
        rear = bool(scan.flags & ScanFlag.REAR_MIRROR_SIDE)
        if self.upside_down or scan.status & ScannerStatus.UPSIDE_DOWN:
            rear = not rear
        elevation = elevation_rad(layer, azimuth_rad, self.beam_tilt_rad, rear)
        if self._is_tilted:
            azimuth_rad, elevation = self._level(azimuth_rad, elevation)
        range_cm = points["range_cm"].astype(np.float64)
        width_cm = points["width_cm"]

        candidates = np.arange(len(points))
        if self._config.height_m is not None:
            height_cm = self._config.height_m * 100.0 + range_cm * np.sin(elevation)
            above = height_cm >= self._config.ground_below_m * 100.0
            self._count("points_below_ground_limit", len(points) - np.count_nonzero(above))
            candidates = candidates[above]
        candidates = self._one_echo_a_shot(scan, points, layer, angle_ticks, candidates)
        if self._is_tilted:
            turned = azimuth_rad[candidates] * (scan.ticks_per_turn / (2.0 * math.pi))
            beam = np.rint((first_ticks - turned) / step).astype(np.int64)
            inside = (beam >= 0) & (beam < beam_count)
            candidates, beam = candidates[inside], beam[inside]
        else:
            beam = (first_ticks - angle_ticks[candidates] + step // 2) // step
        chosen = self._one_point_a_beam(beam, beam_count, elevation, points["range_cm"], candidates)
        beam = chosen >> 16
        index = chosen & _INDEX_MASK
        beams.range_m[beam] = range_cm[index] * np.cos(elevation[index]) * 0.01
        beams.width_cm[beam] = width_cm[index]
        return beams

    def sees(self, scan: Scan) -> bool:
        """Whether a part of the scan lies within the configured angles."""
        start_ticks, end_ticks = self._sector_ticks(scan)
        return start_ticks > end_ticks

    def _sector_ticks(self, scan: Scan) -> tuple[int, int]:
        """Start and end of what the scan and the config have in common."""
        return (min(scan.start_ticks, self._config.first_ticks), max(scan.end_ticks, self._config.last_ticks))

    def _usable(self, scan: Scan) -> tuple[Mask, dict[str, Mask]]:
        """(N,) the points that may count, by themselves, and by label those that would without it."""
        points = scan.points
        layer, sound = points["layer_echo"] & 0x0F, sound_points(scan)
        self._count("points_malformed", len(points) - np.count_nonzero(sound))
        is_wanted = np.ones(len(points), np.bool_)
        labels: dict[str, Mask] = {}
        for name, (point_flag, scan_flag) in LABELS.items():
            if not scan.flags & scan_flag:
                continue
            labels[name] = points["flags"] & point_flag != 0
            self._count(f"points_{name}", np.count_nonzero(labels[name]))
            if name in self._config.discard:
                is_wanted &= ~labels[name]
            else:
                del labels[name]
        start_ticks, end_ticks = self._sector_ticks(scan)
        inside = (points["angle_ticks"] <= start_ticks) & (points["angle_ticks"] >= end_ticks)
        inside &= sound & self._wanted_layer[layer]
        usable = inside & is_wanted
        nearest_cm, farthest_cm = self._range_limits_cm
        in_range = (points["range_cm"] >= nearest_cm) & (points["range_cm"] <= farthest_cm)
        self._count("points_out_of_range", np.count_nonzero(usable & ~in_range))
        return usable & in_range, {name: labelled & inside & in_range for name, labelled in labels.items()}

    def _level(self, azimuth_rad: Floats, elevation: Floats) -> tuple[Floats, Floats]:
        """Azimuth and elevation in the vehicle's level, from those in the pitched and rolled sensor."""
        pitch, roll = math.radians(self._config.pitch_deg), math.radians(self._config.roll_deg)
        x, y = np.cos(elevation) * np.cos(azimuth_rad), np.cos(elevation) * np.sin(azimuth_rad)
        z = np.sin(elevation)
        y, z = math.cos(roll) * y - math.sin(roll) * z, math.sin(roll) * y + math.cos(roll) * z
        x, z = math.cos(pitch) * x + math.sin(pitch) * z, math.cos(pitch) * z - math.sin(pitch) * x
        return np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0))

    def _one_echo_a_shot(
        self,
        scan: Scan,
        points: npt.NDArray[np.void],
        layer: Integers,
        angle_ticks: Integers,
        candidates: Integers,
    ) -> Integers:
        """The configured echo of the candidates of each layer and angle."""
        echo = (points["layer_echo"] >> 4)[candidates].astype(np.int64)
        if not echo.any():
            return candidates
        if self._config.echo == "strongest":
            rank = 0xFFFF - points["width_cm"][candidates].astype(np.int64)
        else:
            rank = echo if self._config.echo == "first" else ECHO_COUNT - echo
        width = scan.start_ticks - scan.end_ticks + 1
        shot = layer[candidates] * width + (scan.start_ticks - angle_ticks[candidates])
        best = np.full(LAYER_COUNT * width, _FREE)
        np.minimum.at(best, shot, rank << 16 | candidates)
        chosen: Integers = best[best != _FREE] & _INDEX_MASK
        return chosen

    def _one_point_a_beam(
        self,
        beam: Integers,
        beam_count: int,
        elevation: Floats,
        range_cm: npt.NDArray[np.uint16],
        candidates: Integers,
    ) -> Integers:
        """beam << 16 | index of the point chosen, for each beam that has one."""
        key = range_cm[candidates].astype(np.int64) << 16 | candidates
        if self._config.layer_choice == "median":
            in_order = np.sort(beam << 32 | key)
            place = np.flatnonzero(np.diff(in_order >> 32, prepend=-1))
            count = np.diff(place, append=len(in_order))
            middle: Integers = in_order[place + (count - 1) // 2]
            return middle >> 32 << 16 | middle & _INDEX_MASK
        if self._config.layer_choice == "horizon":
            hundredth_deg = np.rint(np.abs(elevation[candidates]) * (18_000.0 / math.pi)).astype(np.int64)
            key |= hundredth_deg << 32
        best = np.full(beam_count, _FREE)
        np.minimum.at(best, beam, key)
        taken = np.flatnonzero(best != _FREE)
        nearest: Integers = taken << 16 | best[taken] & _INDEX_MASK
        return nearest

    def _count(self, name: str, count: int | np.integer[Any]) -> None:
        if count:
            self._counters[name] += int(count)
