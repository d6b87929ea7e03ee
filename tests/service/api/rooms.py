"""A drive of four seconds through a room that looks the same from nowhere else, and its recording."""

from functools import cache
from pathlib import Path

from tests.recorded_drive import record
from tests.service.mapper.drives import MOUNTING, ROOM, Drive, drive, round_the_room
from tests.service.recording.sessions import T0_NS

MOUNTINGS = {"front": (MOUNTING.x_m, MOUNTING.y_m, MOUNTING.theta_rad)}


@cache
def driven() -> Drive:
    return drive(ROOM, round_the_room, 4.0, every=4)


def recorded(folder: Path, name: str = "session.mcap") -> Path:
    """The session of the recorder, without a config."""
    return record(driven().frames, {"front": MOUNTING}, folder, T0_NS).rename(folder / name)
