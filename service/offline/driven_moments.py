"""The moments of a trajectory: where the vehicle was on its way through a map that is finished."""

from bisect import bisect_right

import numpy as np
import numpy.typing as npt

from service.encoding import BASE_FRAME, MAP_FRAME, Pose
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.offline.moments import Moment, thinned
from service.web.live_view import MOST_PATH_POINTS, PATH_STEP_M

MAP_WORDS = "map as it is in the end"
NOT_KNOWN = float("nan")


class DrivenMoments:
    """stamp_ns, poses    (N,) rising, at least one, and (N, 3) base in map; x m, y m, theta rad"""

    def __init__(self, stamp_ns: npt.NDArray[np.int64], poses: Floats) -> None:
        self._stamp_ns = stamp_ns
        self._poses = poses
        self._rows = thinned(poses[:, :2], PATH_STEP_M, MOST_PATH_POINTS)
        self.path_map: Floats = poses[self._rows, :2]

    @property
    def first_ns(self) -> int:
        return int(self._stamp_ns[0])

    @property
    def last_ns(self) -> int:
        return int(self._stamp_ns[-1])

    def at(self, at_ns: int) -> Moment:
        """The newest pose by then. at_ns: not before the first."""
        k = int(np.searchsorted(self._stamp_ns, at_ns, side="right")) - 1
        pose = Pose(
            stamp_ns=int(self._stamp_ns[k]),
            frame=MAP_FRAME,
            child=BASE_FRAME,
            pose=SE2(*self._poses[k].tolist()),
            covariance=np.full((3, 3), NOT_KNOWN),
            twist=(NOT_KNOWN, NOT_KNOWN, NOT_KNOWN),
        )
        return Moment(at_ns, [pose], (0, bisect_right(self._rows, k)), MAP_WORDS)
