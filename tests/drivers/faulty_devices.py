"""Every device there is with faults on it, and the sessions of its driver, in virtual time."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
from drivers.ibeo_lux.driver import IbeoLuxSession
from drivers.irobot_create.driver import session_maker as create_sessions
from drivers.link import Session
from drivers.sick_lms100.driver import Lms100Session
from drivers.sick_lms100.protocol import Dialect
from drivers.xsens_mtig.driver import XsensMtigSession
from simulators.device import FakeDevice
from simulators.fault_file import parse_faults
from simulators.faults import Faulty
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from simulators.ibeo_lux import FakeIbeoLux, LuxSetup
from simulators.irobot_create import FakeCreate
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from simulators.xsens_mtig import FakeMtiG, MtigSetup
from tests.drivers import irobot_bench, lms100, lux, mtig, utm30lx
from tests.drivers.virtual_link import VirtualLink
from tests.drivers.virtual_time import SECOND_NS

ZERO_NS = 1_000 * SECOND_NS


@dataclass(frozen=True)
class Bench:
    """How to make the fake device and its driver's sessions, and what to expect of them.

    sessions     now_ns of the link -> what makes a session
    has_clock    the device shows one
    has_sum      its messages carry a checksum
    fineness_ns  how well its stamps can be known, from one connection to the next
    """

    device: Callable[[], FakeDevice]
    sessions: Callable[[Callable[[], int]], Callable[[], Session]]
    rate_hz: float
    has_clock: bool = True
    has_sum: bool = True
    fineness_ns: int = 100_000


def _lms100(dialect: Dialect, model: Any = "lms1xx", rate_hz: float = 49.8, **changes: Any) -> Bench:
    return Bench(
        lambda: FakeLms100(lms100.Room(), Lms100Setup(model, dialect=dialect)),
        lambda now: partial(Lms100Session, lms100.config(model=model, **changes)),
        rate_hz=rate_hz,
        has_sum=dialect is Dialect.BINARY,
    )


def _utm30lx(wire: Any, model: Any = "utm_30lx", rate_hz: float = 39.92, **changes: Any) -> Bench:
    """Its motor is a little off: at 25 ms sharp, its milliseconds would always say the same of the phase."""
    setup = Utm30lxSetup(wire, model, motor_speed=0.998, clock_drift_ppm=20.0)
    return Bench(
        lambda: FakeUtm30lx(utm30lx.Room(), setup),
        lambda now: partial(HokuyoUtm30lxSession, utm30lx.config(model=model, **changes)),
        rate_hz=rate_hz,
        fineness_ns=1_000_000,  # it counts milliseconds
    )


def _mtig(personality: Any) -> Bench:
    setup = MtigSetup(personality=personality)
    return Bench(
        lambda: FakeMtiG(mtig.Swing(), setup),
        lambda now: partial(XsensMtigSession, mtig.config()),
        rate_hz=200.0,
    )


BENCHES = {
    "lms100 cola_a": _lms100(Dialect.ASCII),
    "lms100 cola_b": _lms100(Dialect.BINARY, port=2112),
    "utm30lx usb": _utm30lx("usb"),
    "utm30lx ethernet": _utm30lx("ethernet", host="127.0.0.1"),
    "lux": Bench(
        lambda: FakeIbeoLux(lux.Room(), LuxSetup()),
        lambda now: lambda: IbeoLuxSession(lux.config(), lambda: lux.UNIX_NS + now()),
        rate_hz=25.0,
        has_sum=False,
    ),
    "mtig legacy": _mtig("legacy"),
    "mtig mtdata2": _mtig("mtdata2"),
    "create2": Bench(
        lambda: FakeCreate(irobot_bench.STANDING, wakes_on_connect=True),
        lambda now: create_sessions(irobot_bench.CONFIG),
        rate_hz=1000 / 15,
        has_clock=False,
    ),
    "create1": Bench(
        lambda: FakeCreate(irobot_bench.STANDING, "create1", wakes_on_connect=True),
        lambda now: create_sessions(irobot_bench.CREATE1),
        rate_hz=10.0,
        has_clock=False,
        has_sum=False,
    ),
    "lms100 lms5xx": _lms100(Dialect.BINARY, "lms5xx"),
    "lms100 tim5xx": _lms100(Dialect.ASCII, "tim5xx", 14.93),
    "utm30lx ust": _utm30lx("ethernet", "ust", host="127.0.0.1"),
    "utm30lx urg": _utm30lx("usb", "urg_04lx_ug01", 9.98),
}


def faulty(device: FakeDevice, *lines: str, seed: int = 1) -> Faulty:
    """The device with these faults: lines of YAML without the device's name."""
    text = "faults:\n" + "".join(f"  - {{device: x, {line}}}\n" for line in lines)
    return Faulty(device, parse_faults(text, "faults.yaml", {"x": device}), seed, ZERO_NS)


def linked(name: str, *lines: str) -> VirtualLink:
    """A device of that bench with these faults, and its link."""
    bench = BENCHES[name]
    link: VirtualLink
    sessions = bench.sessions(lambda: link.now_ns)
    link = VirtualLink(sessions, faulty(bench.device(), *lines), ZERO_NS)
    return link
