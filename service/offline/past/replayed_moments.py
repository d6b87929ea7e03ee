"""The moments of a recording that was mapped just now: its scans in the map as it is in the end."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from drivers.frames import LaserScan
from service.encoding import frame_id
from service.errors import InputError
from service.geometry.poses import Floats
from service.offline.past.driven_moments import DrivenMoments
from service.offline.past.moments import STALE_NS, Moment
from service.recording.mcap_source import Session
from service.recording.sources import SCAN_TYPES

LATER_NS = 1_000_000_000  # a scan that was measured before another may be logged so long after it


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
