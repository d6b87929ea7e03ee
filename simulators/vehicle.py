"""A vehicle full of fake devices: from `front=sick_lms100:port=2111` to a device on a wire."""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from drivers.irobot_create.config import PRESETS
from drivers.xsens_mtig.protocol import CODE_OF_BAUD
from service.geometry.se2 import SE2
from simulators.device import TURNS_SKIPPED, CountsTurns, FakeDevice, ManyClients
from simulators.fault_file import Fault
from simulators.faults import Faulty
from simulators.hokuyo_utm30lx import FakeUtm30lx, Utm30lxSetup
from simulators.ibeo_lux import FakeIbeoLux, LuxSetup
from simulators.inertial import Datum, ImuMounting, InertialTruth
from simulators.irobot_create import FakeCreate
from simulators.sick_lms100 import FakeLms100, Lms100Setup
from simulators.truth import (
    CREATE_WHEELS,
    IBEO_LUX,
    LMS100,
    UTM30LX,
    LaserTruth,
    Ride,
    WheelTruth,
    seed_of,
)
from simulators.wire import DROPPED, PtyWire, TcpWire, serve_pty, serve_tcp
from simulators.world import World
from simulators.xsens_mtig import FakeMtiG, MtigSetup, Personality

DEFAULT_DEVICES = ("front=sick_lms100", "base=irobot_create")

Wire = TcpWire | PtyWire


class Lms100Options(BaseModel):
    """What may stand behind `sick_lms100:`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    port: int = Field(default=0, ge=0, le=65535)  # 0: any free
    x_m: float = 0.20  # mounting in the base frame, as in config/vehicle.yaml
    y_m: float = 0.0
    yaw_deg: float = 0.0
    sigma_m: float = Field(default=LMS100.sigma_m, ge=0.0)
    bias_m: float = LMS100.bias_m
    clock_drift_ppm: float = 40.0


class Utm30lxOptions(BaseModel):
    """What may stand behind `hokuyo_utm30lx:`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    wire: Literal["usb", "ethernet"] = "usb"  # UTM-30LX on a terminal; UTM-30LX-EW on a TCP port
    link: Path | None = None  # usb: a symbolic link to the terminal, a name that stays
    host: str = "127.0.0.1"  # ethernet
    port: int = Field(default=0, ge=0, le=65535)  # 0: any free
    x_m: float = 0.20  # mounting in the base frame
    y_m: float = 0.0
    yaw_deg: float = 0.0
    sigma_m: float = Field(default=UTM30LX.sigma_m, ge=0.0)
    bias_m: float = UTM30LX.bias_m
    clock_drift_ppm: float = 40.0
    motor_speed: float = Field(default=1.0, ge=0.9, le=1.1)  # of 40 turns a second


class LuxOptions(BaseModel):
    """What may stand behind `ibeo_lux:`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    port: int = Field(default=0, ge=0, le=65535)  # 0: any free
    x_m: float = 0.25  # mounting in the base frame
    y_m: float = 0.0
    yaw_deg: float = 0.0
    sigma_m: float = Field(default=IBEO_LUX.sigma_m, ge=0.0)
    bias_m: float = IBEO_LUX.bias_m
    clock_drift_ppm: float = 40.0
    height_m: float | None = Field(default=None, gt=0.0)  # above ground, which the low layers then meet
    rain_share: float = Field(default=0.0, ge=0.0, le=1.0)  # of the shots that meet a drop first


class CreateOptions(BaseModel):
    """What may stand behind `irobot_create:`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: Literal["create1", "create2", "roomba"] = "create2"
    link: Path | None = None  # a symbolic link to the terminal, a name that stays
    scale_sigma: float = Field(default=CREATE_WHEELS.scale_sigma, ge=0.0)
    slip_sigma_m: float = Field(default=CREATE_WHEELS.slip_sigma_m, ge=0.0)
    slips_per_m: float = Field(default=CREATE_WHEELS.slips_per_m, ge=0.0)


class MtigOptions(BaseModel):
    """What may stand behind `xsens_mtig:`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    personality: Personality = "mtdata2"  # MTi-G-710; legacy: MTi-G
    link: Path | None = None  # a symbolic link to the terminal, a name that stays
    baud: int = 115_200  # stored in the unit; the pace of its line
    x_m: float = 0.0  # mounting in the base frame
    y_m: float = 0.0
    yaw_deg: float = 0.0
    clock_drift_ppm: float = 40.0
    satellites: bool = True
    gnss_sigma_m: float = Field(default=1.5, ge=0.0)
    latitude_deg: float = Field(default=Datum().latitude_deg, ge=-85.0, le=85.0)  # of the world's origin
    longitude_deg: float = Field(default=Datum().longitude_deg, ge=-180.0, le=180.0)
    height_m: float = Datum().height_m
    heading_deg: float = 0.0  # of the world's x axis, counter-clockwise from east

    @field_validator("baud")
    @classmethod
    def _possible(cls, baud: int) -> int:
        if baud not in CODE_OF_BAUD:
            raise ValueError(f"{baud} is none of {sorted(CODE_OF_BAUD)}")
        return baud


@dataclass(frozen=True, slots=True)
class DeviceSpec:
    """One device as it was asked for."""

    name: str
    kind: str
    options: BaseModel


@dataclass(frozen=True, slots=True)
class _Kind:
    options: type[BaseModel]
    build: Callable[[str, Any, Ride, int], Wire]  # name, options, ride, seed


def _build_lms100(name: str, options: Lms100Options, ride: Ride, seed: int) -> Wire:
    mounting = SE2(options.x_m, options.y_m, math.radians(options.yaw_deg))
    model = replace(LMS100, sigma_m=options.sigma_m, bias_m=options.bias_m)
    source = LaserTruth(ride, name, mounting, model, seed)
    setup = Lms100Setup(clock_drift_ppm=options.clock_drift_ppm)
    return serve_tcp(FakeLms100(source, setup, seed_of(seed, name)), options.host, options.port)


def _build_utm30lx(name: str, options: Utm30lxOptions, ride: Ride, seed: int) -> Wire:
    mounting = SE2(options.x_m, options.y_m, math.radians(options.yaw_deg))
    model = replace(UTM30LX, sigma_m=options.sigma_m, bias_m=options.bias_m)
    source = LaserTruth(ride, name, mounting, model, seed)
    setup = Utm30lxSetup(
        options.wire, clock_drift_ppm=options.clock_drift_ppm, motor_speed=options.motor_speed
    )
    device = FakeUtm30lx(source, setup, seed_of(seed, name))
    if options.wire == "usb":
        return serve_pty(device, options.link)
    return serve_tcp(device, options.host, options.port)


def _build_lux(name: str, options: LuxOptions, ride: Ride, seed: int) -> Wire:
    mounting = SE2(options.x_m, options.y_m, math.radians(options.yaw_deg))
    model = replace(IBEO_LUX, sigma_m=options.sigma_m, bias_m=options.bias_m)
    source = LaserTruth(ride, name, mounting, model, seed)
    setup = LuxSetup(
        clock_drift_ppm=options.clock_drift_ppm, height_m=options.height_m, rain_share=options.rain_share
    )
    return serve_tcp(FakeIbeoLux(source, setup, seed_of(seed, name)), options.host, options.port)


def _build_create(name: str, options: CreateOptions, ride: Ride, seed: int) -> Wire:
    model = replace(
        CREATE_WHEELS,
        wheel_base_m=PRESETS[options.model].wheel_base_m,
        scale_sigma=options.scale_sigma,
        slip_sigma_m=options.slip_sigma_m,
        slips_per_m=options.slips_per_m,
    )
    wheels = WheelTruth(ride, name, model, seed)
    return serve_pty(FakeCreate(wheels, options.model, wakes_on_connect=True), options.link)


def _build_mtig(name: str, options: MtigOptions, ride: Ride, seed: int) -> Wire:
    source = InertialTruth(
        ride,
        name,
        ImuMounting(options.x_m, options.y_m, math.radians(options.yaw_deg)),
        seed=seed,
        datum=Datum(
            options.latitude_deg, options.longitude_deg, options.height_m, math.radians(options.heading_deg)
        ),
        gnss_sigma_m=options.gnss_sigma_m if options.satellites else None,
    )
    setup = MtigSetup(options.personality, options.baud, options.clock_drift_ppm)
    return serve_pty(FakeMtiG(source, setup), options.link)


KINDS = {
    "sick_lms100": _Kind(Lms100Options, _build_lms100),
    "hokuyo_utm30lx": _Kind(Utm30lxOptions, _build_utm30lx),
    "irobot_create": _Kind(CreateOptions, _build_create),
    "ibeo_lux": _Kind(LuxOptions, _build_lux),
    "xsens_mtig": _Kind(MtigOptions, _build_mtig),
}


def parse_device(text: str) -> DeviceSpec:
    """Read NAME=TYPE[:key=value,...]. Raises ValueError that says what is wrong."""
    name, _, rest = text.partition("=")
    kind, _, options_text = rest.partition(":")
    if not name or kind not in KINDS:
        raise ValueError(f"{text!r}: expected NAME=TYPE[:key=value,...] with TYPE one of {', '.join(KINDS)}")
    options: dict[str, str] = {}
    for item in options_text.split(",") if options_text else []:
        key, equals, value = item.partition("=")
        if not equals or key in options:
            raise ValueError(f"{text!r}: {item!r} is not a new key=value")
        options[key] = value
    try:
        return DeviceSpec(name, kind, KINDS[kind].options.model_validate(options))
    except ValidationError as error:
        known = ", ".join(KINDS[kind].options.model_fields)
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise ValueError(f"{text!r}: {key}: {first['msg']}; {kind} takes {known}") from error


def parse_devices(texts: Sequence[str]) -> list[DeviceSpec]:
    """Raises ValueError also where two devices share a name."""
    specs = [parse_device(text) for text in texts or DEFAULT_DEVICES]
    names = [spec.name for spec in specs]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two devices are called {name!r}")
    return specs


def warm_up(world: World) -> None:
    """Compile the kernels, or fetch them from the cache."""
    LaserTruth(Ride(world, 0), "warm-up", SE2(), LMS100, 0).sweep(0, 27_778, -1.0, 0.01, 200)


class FakeVehicle:
    """Context manager: its devices are on their wires while it is entered."""

    def __init__(self, specs: Sequence[DeviceSpec], ride: Ride, seed: int) -> None:
        self._specs = list(specs)
        self.wires = {
            spec.name: KINDS[spec.kind].build(spec.name, spec.options, ride, seed) for spec in self._specs
        }
        self._stack = ExitStack()

    @property
    def devices(self) -> dict[str, FakeDevice | ManyClients]:
        return {name: wire.device for name, wire in self.wires.items()}

    def afflict(self, faults: Sequence[Fault], seed: int, zero_ns: int) -> None:
        """Give each device its faults, timed from host time zero_ns. To be done before it is entered."""
        for name, device in self.devices.items():
            own = [fault for fault in faults if fault.device == name]
            if own:
                assert not isinstance(device, ManyClients), "refused by whoever read the faults"
                self.wires[name].device = Faulty(device, own, seed_of(seed, f"faults of {name}"), zero_ns)

    def fault_counters(self) -> dict[str, dict[str, int]]:
        """What the faults have done so far, by device."""
        return {
            name: dict(device.counters) for name, device in self.devices.items() if isinstance(device, Faulty)
        }

    def losses(self) -> dict[str, dict[str, int]]:
        """What was lost on this side so far, by device: turns that this process came too late for, and
        messages that the reader was too slow for."""
        found = {}
        for name, wire in self.wires.items():
            device = wire.device.device if isinstance(wire.device, Faulty) else wire.device
            skipped = device.counters[TURNS_SKIPPED] if isinstance(device, CountsTurns) else 0
            dropped = wire.counters[DROPPED]
            counts = {TURNS_SKIPPED: skipped, DROPPED: dropped}
            found[name] = {what: count for what, count in counts.items() if count}
        return found

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for name, wire in self.wires.items():
                if isinstance(wire, PtyWire) and isinstance(wire.device, Faulty) and wire.link is None:
                    # each time it is plugged in it is another terminal; a name that stays leads there
                    folder = stack.enter_context(TemporaryDirectory(prefix="corridor-"))
                    wire.link = Path(folder) / name
                stack.enter_context(wire)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def endpoints(self) -> list[dict[str, str]]:
        """One entry a device: name, device, endpoint (`tcp://host:port` or a path)."""
        lines = []
        for spec in self._specs:
            endpoint = self.wires[spec.name].endpoint
            where = endpoint if isinstance(endpoint, str) else f"tcp://{endpoint[0]}:{endpoint[1]}"
            lines.append({"name": spec.name, "device": spec.kind, "endpoint": where})
        return lines

    @property
    def failed(self) -> list[str]:
        """Names of the devices whose wire ended on an error."""
        return [name for name, wire in self.wires.items() if wire.failure is not None]
