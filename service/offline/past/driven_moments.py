"""The moments of a trajectory, and of a recording that was mapped just now, in a map that is finished."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from drivers.frames import LaserScan
from service.encoding import BASE_FRAME, MAP_FRAME, Pose, frame_id
from service.errors import InputError
from service.geometry.poses import Floats, between
from service.geometry.se2 import SE2, wrap_angle
from service.offline.past.moments import STALE_NS, Moment, thinned
from service.recording.mcap_source import Session
from service.recording.sources import SCAN_TYPES
from service.web.live_view import MAX_PATH_POINTS, PATH_STEP_M
from service.web.series import MAX_ROWS, Row

MAP_WORDS = "map as it is in the end"
NOT_KNOWN = float("nan")
LATER_NS = 1_000_000_000  # a scan that was measured before another may be logged so long after it


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


class ReplayedMoments(DrivenMoments):
    """stamp_ns, log_ns, poses    (N,) rising, (N,) and (N, 3) of the scans mapped, at least one: when each
    was measured and logged, and where the base was in the finished map; x m, y m, theta rad
    """

    def __init__(
        self, session: Session, stamp_ns: npt.NDArray[np.int64], log_ns: npt.NDArray[np.int64], poses: Floats
    ) -> None:
        super().__init__(stamp_ns, poses)
        self._session = session
        self._log_ns = log_ns
        types = {topic.name: topic.type for topic in session.recording.topics}
        self._topics = [topic for topic in session.devices if types.get(topic) in SCAN_TYPES]

    def at(self, at_ns: int) -> Moment:
        """Raises InputError where the recording cannot be read any more."""
        scans, moment = self._scans(at_ns), super().at(at_ns)
        newest = moment.poses[-1]
        around = {pose.stamp_ns: pose for scan in scans for pose in self.around(scan.stamp_ns)}
        before = [around[stamp_ns] for stamp_ns in sorted(around) if stamp_ns < newest.stamp_ns]
        return replace(moment, poses=[*before, newest], scans=scans, mountings=self._session.mountings)

    def _scans(self, at_ns: int) -> Sequence[LaserScan]:
        """The newest of each laser that was measured by then."""
        log_ns = int(self._log_ns[self._newest(at_ns)])
        newest: dict[str, LaserScan] = {}
        for message in self._session.recording.messages(self._topics, log_ns - STALE_NS, log_ns + LATER_NS):
            try:
                sensor = self._session.devices[self._session.topic_of(message)].get(frame_id(message.payload))
                if sensor is None:
                    continue
                scan = self._session.decode(message, sensor)
            except InputError:
                continue  # counted when it was mapped
            if isinstance(scan, LaserScan) and at_ns - STALE_NS <= scan.stamp_ns <= at_ns:
                newest[sensor] = scan
        return list(newest.values())
