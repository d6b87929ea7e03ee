"""The moments of a trajectory: where the vehicle was in a map that is finished."""

from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from service.encoding import BASE_FRAME, MAP_FRAME, Pose
from service.geometry.poses import Floats, between
from service.geometry.se2 import SE2, wrap_angle
from service.offline.past.moments import Moment, thinned
from service.web.live_view import MAX_PATH_POINTS, PATH_STEP_M
from service.web.series import MAX_ROWS, Row

MAP_WORDS = "map as it is in the end"
NOT_KNOWN = float("nan")


class DrivenMoments:
    """stamp_ns, poses    (N,) rising, at least one, and (N, 3) base in map; x m, y m, theta rad"""

    def __init__(self, stamp_ns: npt.NDArray[np.int64], poses: Floats) -> None:
        self._stamp_ns = stamp_ns
        self._poses = poses
        self._rows = thinned(poses[:, :2], PATH_STEP_M, MAX_PATH_POINTS)
        self.path_map: Floats = poses[self._rows, :2]

    @property
    def rows(self) -> Sequence[Row]:
        """The speed, of each second or of a longer part of a long drive."""
        every_ns = max(1_000_000_000, (self.last_ns - self.first_ns) // MAX_ROWS)
        wanted = np.arange(self.first_ns, self.last_ns + 1, every_ns)
        chosen = np.unique(np.searchsorted(self._stamp_ns, wanted, side="right") - 1).tolist()
        return [Row(self._stamp_ns[k] / 1e9, "", 0, {"speed_mps": self._twist(k)[0]}) for k in chosen]

    @property
    def first_ns(self) -> int:
        return int(self._stamp_ns[0])

    @property
    def last_ns(self) -> int:
        return int(self._stamp_ns[-1])

    def at(self, at_ns: int) -> Moment:
        """The newest pose by then."""
        k = self._newest(at_ns)
        return Moment(at_ns, [self._pose(k)], (0, bisect_right(self._rows, k)), MAP_WORDS)

    def around(self, at_ns: int) -> list[Pose]:
        """The newest pose by then, and the one after it."""
        k = self._newest(at_ns)
        return [self._pose(k), self._pose(min(k + 1, len(self._poses) - 1))]

    def _newest(self, at_ns: int) -> int:
        return max(int(np.searchsorted(self._stamp_ns, at_ns, side="right")) - 1, 0)

    def _pose(self, k: int) -> Pose:
        return Pose(
            stamp_ns=int(self._stamp_ns[k]),
            frame=MAP_FRAME,
            child=BASE_FRAME,
            pose=SE2(*self._poses[k].tolist()),
            covariance=np.full((3, 3), NOT_KNOWN),
            twist=self._twist(k),
        )

    def _twist(self, k: int) -> tuple[float, float, float]:
        """From this pose to the next one; of the last, from the one before."""
        if len(self._poses) < 2:
            return 0.0, 0.0, 0.0
        k = min(k, len(self._poses) - 2)
        step = between(self._poses[k], self._poses[k + 1])
        seconds = (self._stamp_ns[k + 1] - self._stamp_ns[k]) / 1e9
        return float(step[0] / seconds), float(step[1] / seconds), float(wrap_angle(step[2]) / seconds)
