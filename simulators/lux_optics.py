"""The sweeps of a fake LUX as the points of its scan. No I/O."""

import math

import numpy as np
import numpy.typing as npt

from drivers.ibeo_lux.messages import POINT, PointFlag, ScanFlag

LOWER_PAIR_LAST_TICKS = -1600  # layers 0 and 1 from 50 to -50 deg, as recorded
UPPER_PAIR_FIRST_TICKS = 1120  # layers 2 and 3 from 35 deg
FOCUSED_SECTORS = ((320, 4), (960, 8), (1920, 16))  # up to so many ticks off the middle, ticks a shot
LAYER_STEP_RAD = math.radians(0.8)
NEAREST_CM, FARTHEST_CM = 30, 20_000


class LuxOptics:
    """labels are the ScanFlag of those that run; height_m above ground, None: no ground; rain_share of the
    shots meets a drop before the wall.
    """

    def __init__(
        self, labels: int, height_m: float | None, rain_share: float, noise: np.random.Generator
    ) -> None:
        self._labels = labels
        self._height_m = height_m
        self._rain_share = rain_share
        self._noise = noise

    def points(
        self,
        angle_ticks: npt.NDArray[np.int64],
        range_m: npt.NDArray[np.float32],
        intensity: npt.NDArray[np.float32],
    ) -> npt.NDArray[np.void]:
        """Two layers a shot, two echoes a layer where there is rain, in the order of the wire.

        range_m, intensity: (shots, 2), of the pair's lower and upper layer.
        """
        count = len(angle_ticks)
        points = np.zeros((count, 2, 2), POINT)  # shot, layer of the pair, echo
        upper = np.arange(count) % 2 == 1
        layer = np.where(upper, 2, 0)[:, None] + np.arange(2)
        visible = np.where(upper, angle_ticks <= UPPER_PAIR_FIRST_TICKS, angle_ticks >= LOWER_PAIR_LAST_TICKS)
        elevation = (layer - 1.5) * LAYER_STEP_RAD
        wall_m = range_m / np.cos(elevation)
        ground_m = np.full_like(wall_m, np.inf)
        if self._height_m is not None:
            down = elevation < 0.0
            ground_m[down] = self._height_m / np.sin(-elevation[down])
        is_ground = ~(wall_m <= ground_m) & np.isfinite(ground_m)
        wall_m = np.where(is_ground, ground_m, wall_m)
        wet = self._noise.random((count, 2)) < self._rain_share
        drop_m = np.where(wet, self._noise.uniform(0.5, 5.0, (count, 2)), np.nan)
        wet &= drop_m < np.where(np.isnan(wall_m), np.inf, wall_m)

        cm = np.nan_to_num(np.rint(np.stack([drop_m, wall_m], axis=2) * 100.0))
        points["range_cm"] = np.clip(cm, 0, FARTHEST_CM + 1)
        points["angle_ticks"] = angle_ticks[:, None, None]
        points["width_cm"][:, :, 0] = 60
        points["width_cm"][:, :, 1] = 80 + np.rint(40 * intensity) * 4
        points["layer_echo"][:, :, 0] = layer
        points["layer_echo"][:, :, 1] = layer | wet.astype(np.int64) << 4
        points["flags"] = self._flags(is_ground, wet)
        there = (
            (points["range_cm"] >= NEAREST_CM) & (points["range_cm"] <= FARTHEST_CM) & visible[:, None, None]
        )
        there[:, :, 0] &= wet
        return points[there]

    def _flags(self, is_ground: npt.NDArray[np.bool_], wet: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
        """(S, 2, 2) reserved bits as recorded, labels, random ones where labelling did not run."""
        flags = 0x40 | self._noise.integers(0, 2, (*is_ground.shape, 2)) << 4
        if self._labels & ScanFlag.GROUND_LABELLED:
            flags[:, :, 1] |= is_ground * PointFlag.GROUND
        else:
            flags |= (self._noise.random(flags.shape) < 0.86) * PointFlag.GROUND
        if self._labels & ScanFlag.RAIN_LABELLED:
            flags[:, :, 0] |= wet * PointFlag.RAIN
        return flags.astype(np.uint8)


def is_shot(angle_ticks: npt.NDArray[np.int64], start_ticks: int) -> npt.NDArray[np.bool_]:
    """(N,) which rays the focused resolution fires."""
    off = np.abs(angle_ticks)
    step = np.full(len(angle_ticks), FOCUSED_SECTORS[-1][1])
    for limit, ticks in reversed(FOCUSED_SECTORS):
        step[off <= limit] = ticks
    fired: npt.NDArray[np.bool_] = (start_ticks - angle_ticks) % step == 0
    return fired
