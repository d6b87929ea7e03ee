"""For tests: a fake ride that tells the time by its rates, and talks with a fake MTi-G."""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from drivers.frames import Frame, GnssFix, ImuSample
from drivers.xsens_mtig.config import XsensMtigConfig
from drivers.xsens_mtig.driver import XsensMtigSession
from drivers.xsens_mtig.mtdata2 import GnssPvt
from simulators.device import FakeDevice
from simulators.inertial import Inertial, Place
from simulators.xsens_mtig import FakeMtiG, MtigSetup
from tests.drivers.virtual_time import SECOND_NS, Talk

MS = 1_000_000
ZERO_NS = 1_000 * SECOND_NS
PLACE = Place(60.161, 24.546, 52.0, (0.5, 1.5, 0.0), 2.0, 3.0, 9)
YAW_RAD = 0.4
GOOD_PVT = GnssPvt._make([0] * len(GnssPvt._fields))._replace(
    year=2019, month=1, day=20, hour=13, minute=47, second=24, valid=7, fix=3, flags=1, satellites=9,
    lat_1e7deg=601_610_000, lon_1e7deg=245_460_000, height_mm=52_000, horizontal_accuracy_mm=2_000,
    vertical_accuracy_mm=3_000,
)  # fmt: skip


class Swing:
    """InertialSource: z turns at a rate that is the time, in s since ZERO_NS; so a sample tells when it was
    taken. The unit lies level, looking YAW_RAD left of east.
    """

    def __init__(self, place: Place | None = PLACE) -> None:
        self._place = place

    def inertial(self, stamps_ns: npt.NDArray[np.int64]) -> Inertial:
        count = len(stamps_ns)
        rate, force = np.zeros((count, 3)), np.zeros((count, 3))
        rate[:, 0], rate[:, 1], rate[:, 2] = 0.1, -0.2, (stamps_ns - ZERO_NS) * 1e-9
        force[:, 0], force[:, 1], force[:, 2] = 0.3, 0.5, 9.81
        c, s = math.cos(YAW_RAD), math.sin(YAW_RAD)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return Inertial(rate, force, np.repeat(turn[np.newaxis], count, axis=0))

    def place(self, stamp_ns: int) -> Place | None:
        return self._place

    def estimates(self, stamps_ns: npt.NDArray[np.int64]) -> list[Place] | None:
        return None if self._place is None else [self._place] * len(stamps_ns)


def config(**changes: object) -> XsensMtigConfig:
    return XsensMtigConfig.model_validate({"name": "imu", "device": "/dev/null", **changes})


def talk(
    unit: FakeDevice | None = None, delay_ns: Callable[[], int] | None = None, **changes: object
) -> Talk:
    """A session that has been connected to a fake device, before the first message."""
    made = Talk(XsensMtigSession(config(**changes)), unit or FakeMtiG(Swing()), ZERO_NS)
    if delay_ns is not None:
        made.delay_ns = delay_ns
    return made.connect()


def legacy(**setup: object) -> FakeMtiG:
    return FakeMtiG(Swing(), MtigSetup(personality="legacy", **setup))  # type: ignore[arg-type]


def mtdata2(**setup: object) -> FakeMtiG:
    return FakeMtiG(Swing(), MtigSetup(**setup))  # type: ignore[arg-type]


def samples(frames: list[Frame]) -> list[ImuSample]:
    return [frame for frame in frames if isinstance(frame, ImuSample)]


def fixes(frames: list[Frame]) -> list[GnssFix]:
    return [frame for frame in frames if isinstance(frame, GnssFix)]
