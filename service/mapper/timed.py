"""What the timing in front of a mapping session hears of the frames that it gave."""

import math

from drivers.frames import Frame, LaserScan
from service.mapper.mapping_session import MappingSession
from service.outputs import MapperOutput
from service.timing import Timing

UNMAPPED = "that the mapper could not use"  # scans with good times, in words for Timing.count_unmapped


def note_mapped(timing: Timing, mapper: MappingSession, frame: Frame, output: MapperOutput | None) -> None:
    """Say where a frame lies that the mapper has processed, or that it was no use."""
    if not isinstance(frame, LaserScan):
        return
    if output is not None:
        heading_rad = output.pose_odom_base.theta_rad if output.state != "lost" else math.nan
        timing.mapped(frame, output.stamp_ns, heading_rad)
    elif mapper.maps(frame):
        timing.count_unmapped(frame, UNMAPPED)
