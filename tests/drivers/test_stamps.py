"""Stamps of every driver against the truth: through jitter, bursts, drift, a wrap and a restart."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from drivers.frames import GnssFix
from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
from drivers.ibeo_lux.driver import IbeoLuxSession
from drivers.irobot_create.driver import session_maker as create_sessions
from drivers.link import Session
from drivers.sick_lms100.driver import Lms100Session
from drivers.sick_lms100.telegrams import OutputRange
from drivers.xsens_mtig.driver import XsensMtigSession
from simulators.device import FakeDevice
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from simulators.ibeo_lux import LEAVES_AFTER_SWEEP_NS, FakeIbeoLux, LuxSetup
from simulators.irobot_create import FakeCreate
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from simulators.xsens_mtig import FakeMtiG, MtigSetup
from tests.drivers import irobot_bench, lms100, lux, mtig, utm30lx
from tests.drivers.virtual_time import SECOND_NS, LateTalk
from tests.soaked import in_soak

Floats = npt.NDArray[np.float64]
NARROW = {
    "first_angle_deg": 10.0,
    "last_angle_deg": -10.0,
}  # what a laser sees is no matter, and quicker made
LUX_LEAVES_MS = LEAVES_AFTER_SWEEP_NS / 1e6


class Wheels(irobot_bench.Curve):
    """Remembers when it was asked."""

    def __init__(self) -> None:
        super().__init__()
        self.first_rays_ns: list[int] = []

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        self.first_rays_ns.append(now_ns)
        return super().wheel_travel_m(now_ns)


@dataclass(frozen=True)
class Case:
    """A fake device, its driver's sessions, and what is known of their stamps.

    truth      remembers when it measured; None: the samples tell by their rate of turn
    bias_ms    lowest and highest mean error: of the latency from device to host, which no driver can measure
    spread_ms  largest standard deviation
    """

    device: FakeDevice
    sessions: Callable[..., Session]  # changes of the config -> a new session
    truth: Any
    bias_ms: tuple[float, float]
    spread_ms: float = 0.2

    def errors_ms(self, frames: list[Any]) -> Floats:
        stamps_ns = np.array([frame.stamp_ns for frame in frames])
        if self.truth is None:
            rates = np.array([frame.rate_radps[2] for frame in frames])
            return (stamps_ns - mtig.ZERO_NS) * 1e-6 - rates * 1e3
        truth_ns = np.array(self.truth.first_rays_ns)
        after = np.clip(np.searchsorted(truth_ns, stamps_ns), 1, len(truth_ns) - 1)
        before_ms, after_ms = ((stamps_ns - truth_ns[at]) / 1e6 for at in (after - 1, after))
        return np.where(np.abs(before_ms) < np.abs(after_ms), before_ms, after_ms)


def of_lms100(drift_ppm: float, zero_index_after_sweep: bool, first_angle_deg: float) -> Case:
    room = lms100.Room()
    setup = Lms100Setup(
        clock_drift_ppm=drift_ppm,
        clock_start_us=2**32 - 10_000_000,
        zero_index_after_sweep=zero_index_after_sweep,
        output_range=OutputRange(round((first_angle_deg + 90) * 1e4), 2_250_000),
    )

    def session(**changes: Any) -> Session:
        return Lms100Session(lms100.config(first_angle_deg=first_angle_deg, **changes))

    return Case(FakeLms100(room, setup), session, room, (0.0, 0.7))


def of_utm30lx(drift_ppm: float, motor_speed: float) -> Case:
    room = utm30lx.Room()
    setup = Utm30lxSetup(motor_speed=motor_speed, clock_drift_ppm=drift_ppm, clock_start_ms=2**24 - 8_000)

    def session(**changes: Any) -> Session:
        return HokuyoUtm30lxSession(utm30lx.config(**utm30lx.NARROW, **changes))

    return Case(FakeUtm30lx(room, setup), session, room, (-1.0, 1.0))  # half of it is the device's ms


def of_lux(drift_ppm: float, set_clock: bool, rate_hz: float) -> Case:
    room = lux.Room()

    def session(**changes: Any) -> Session:
        config = lux.config(scan_rate_hz=rate_hz, set_clock=set_clock, **NARROW, **changes)
        return IbeoLuxSession(config, lambda: lux.UNIX_NS)

    bias_ms = LUX_LEAVES_MS - 0.1, LUX_LEAVES_MS + 0.3
    return Case(FakeIbeoLux(room, LuxSetup(clock_drift_ppm=drift_ppm)), session, room, bias_ms)


def of_mtig(drift_ppm: float, personality: Any, baud: int | None) -> Case:
    setup = MtigSetup(personality, baud, drift_ppm, start_ticks=863_900_000, start_count=62_000)
    wire = {"device": "usb"} if baud is None else {}
    form = "float32" if baud == 115_200 else "fp16.32"

    def session(**changes: Any) -> Session:
        return XsensMtigSession(mtig.config(number_format=form, **wire, **changes))

    return Case(FakeMtiG(mtig.Swing(), setup), session, None, (1.05, 1.15), 0.03)


def of_create(drift_ppm: float) -> Case:
    wheels = Wheels()

    def session(**changes: Any) -> Session:
        return create_sessions(irobot_bench.CONFIG.model_copy(update=changes))()

    return Case(FakeCreate(wheels, clock_drift_ppm=drift_ppm), session, wheels, (-1.0, 2.0))


LINES = [(who, baud) for who in ("mtdata2", "legacy") for baud in (115_200, 460_800, None)]
CASES: list[Callable[[float], Case]] = [
    lambda drift: of_lms100(drift, True, -90.0),
    lambda drift: of_lms100(drift, False, -135.0),
    *(lambda drift, speed=speed: of_utm30lx(drift, speed) for speed in (1.0, 25.0 / 25.05, 1.004)),
    *(lambda drift, hz=hz: of_lux(drift, hz != 25.0, hz) for hz in (12.5, 25.0, 50.0)),
    *(lambda drift, line=line: of_mtig(drift, *line) for line in LINES),
    of_create,
]
IN_SHORT = {(1, -100.0), (3, -100.0), (6, 100.0), (11, -100.0), (14, 100.0)}


def late(seed: int) -> Callable[[int], int]:
    """0.1 ms at the least, uniformly up to 3 ms more, and one in twenty up to 50 ms."""
    rng = np.random.default_rng(seed)

    def delay_ns(sent_ns: int) -> int:
        burst_ms = rng.uniform(0.0, 50.0) if rng.random() < 0.05 else 0.0
        return round((0.1 + rng.uniform(0.0, 3.0) + burst_ms) * 1e6)

    return delay_ns


def measured(frames: list[Any]) -> list[Any]:
    return [frame for frame in frames if not isinstance(frame, GnssFix)]


@pytest.mark.parametrize(
    ("make", "drift_ppm"),
    [
        (make, drift_ppm) if (k, drift_ppm) in IN_SHORT else in_soak(make, drift_ppm)
        for k, make in enumerate(CASES)
        for drift_ppm in (100.0, -100.0)
    ],
)
def test_stamps_scatter_little_and_a_restart_is_over_in_three_seconds(
    make: Callable[[float], Case], drift_ppm: float
):
    case = make(drift_ppm)
    talk = LateTalk(case.sessions(), case.device, late(1))
    begun_ns = talk.now_ns
    talk.run(15.0)
    frames = measured(talk.frames)
    settled_ms = case.errors_ms([f for f in frames if f.stamp_ns > begun_ns + 10 * SECOND_NS])
    assert np.std(settled_ms) <= case.spread_ms
    assert case.bias_ms[0] < np.mean(settled_ms) < case.bias_ms[1]
    assert talk.session.counters["clock_resets"] == 0

    restarted_ns = talk.now_ns
    case.device.restart(restarted_ns)
    talk.reconnect(case.sessions()).run(16.0)
    frames = measured(talk.frames)
    again = [f for f in frames if f.stamp_ns > restarted_ns]
    assert again[0].arrived_ns < restarted_ns + 3 * SECOND_NS
    recovered_ms = case.errors_ms([f for f in again if f.stamp_ns > restarted_ns + 3 * SECOND_NS])
    assert np.abs(recovered_ms - np.mean(settled_ms)).max() < 2.0
    assert np.std(case.errors_ms([f for f in again if f.stamp_ns > restarted_ns + 13 * SECOND_NS])) <= (
        case.spread_ms
    )
    assert np.diff([f.stamp_ns for f in frames]).min() > 0


@pytest.mark.parametrize(
    "make", [CASES[k] for k in (1, 3, 6, 8, 14)], ids=["lms100", "utm30lx", "lux", "mtig", "create"]
)
def test_a_latency_from_calibration_makes_stamps_earlier(make: Callable[[float], Case]):
    stamps_ns = []
    for latency_ms in (0.0, 2.5):
        case = make(0.0)
        talk = LateTalk(case.sessions(latency_ms=latency_ms), case.device, lambda sent_ns: 100_000).run(4.0)
        stamps_ns.append([frame.stamp_ns for frame in measured(talk.frames)[-20:]])
    assert np.subtract(*stamps_ns) == pytest.approx(2_500_000, abs=20_000)
