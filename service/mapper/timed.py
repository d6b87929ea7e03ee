"""Feedback to the timing in front of a mapping session about each frame."""

import math

from drivers.frames import Frame, LaserScan
from service.mapper.mapping_session import MappingSession
from service.outputs import MapperOutput
from service.timing import Timing

UNMAPPED = "that the mapper could not use"  # scans with good stamps; text for Timing.count_unmapped


def note_mapped(timing: Timing, mapper: MappingSession, frame: Frame, output: MapperOutput | None) -> None:
    """Report the stamp and heading at which a frame was mapped, or that the mapper could not use it."""
    if not isinstance(frame, LaserScan):
        return
    if output is not None:
        heading_rad = output.pose_odom_base.theta_rad if output.state != "lost" else math.nan
        timing.mapped(frame, output.stamp_ns, heading_rad)
    elif mapper.maps(frame):
        timing.count_unmapped(frame, UNMAPPED)
