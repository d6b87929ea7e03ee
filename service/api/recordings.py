"""Recordings as frames, whatever wrote them."""

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from drivers.frames import Frame
from service.errors import InputError, UsageError, fault_words
from service.offline.replay.replay import group_sessions
from service.recording.choice import Choice
from service.recording.mcap_source import open_session

log = logging.getLogger(__name__)

AnyPath = str | os.PathLike[str]


class Topics(TypedDict, total=False):
    """Which topics and frames of a recording are used; what is left out is found. As `replay` in a config."""

    scan_topics: Sequence[str]
    odom_topic: str
    imu_topic: str
    base_frame: str
    odom_frame: str


class Recording:
    """One drive; each iteration reads all frames again, by rising time of arrival.

    lasers      names of all that have scans in it
    mountings   sensor -> (3,) x m, y m, yaw rad of lasers and GNSS antennas in the frame of the base
    notes       which devices are read, and what was passed over; a sentence each
    warnings    what was not found and had to be assumed; a sentence each
    """

    def __init__(self, paths: Sequence[Path], choice: Choice) -> None:
        self.session = open_session(paths, choice)
        self.choice = choice
        self.lasers = tuple(self.session.scan_counts)
        self.mountings: Mapping[str, npt.NDArray[np.float64]] = {
            name: np.array(pose) for name, pose in (self.session.mountings | self.session.antennas).items()
        }
        self.notes = tuple(self.session.notes)
        self.warnings = tuple(self.session.warnings)

    def __iter__(self) -> Iterator[Frame]:
        """Raises InputError at a damaged place; messages that cannot be used are counted in the log."""
        yield from self.session.frames()
        for loss in self.session.losses:
            log.warning("%s", loss)


def read(path: AnyPath | Sequence[AnyPath], **topics: Unpack[Topics]) -> Recording:
    """Open whatever `corridor replay` reads: an MCAP, a ROS 1 bag, a ROS 2 bag or its folder, plain or
    packed; several files where one drive was cut into them.

    Raises InputError where that is no recording with a laser, UsageError where a topic is not in it.
    """
    return Recording(one_drive(path), choice_of(topics))


def one_drive(path: AnyPath | Sequence[AnyPath]) -> list[Path]:
    """The files of it, oldest first. Raises InputError where there are several drives."""
    paths = [path] if isinstance(path, str | os.PathLike) else path
    drives = group_sessions([Path(one) for one in paths])
    if len(drives) != 1:
        names = ", ".join(str(files[0]) for files in drives) or "nothing"
        raise InputError(f"expected the recording of one drive, not of {len(drives)} ({names}); give one")
    return drives[0]


def choice_of(topics: Topics) -> Choice:
    """Raises UsageError."""
    try:
        return Choice.model_validate(topics)
    except ValidationError as error:
        raise UsageError(fault_words(error)) from error
