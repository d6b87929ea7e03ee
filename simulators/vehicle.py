"""A vehicle of fake devices: from `front=sick_lms100:port=2111` to a device on a wire."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self

from pydantic import BaseModel, ValidationError

from service.errors import StorageError
from service.geometry.se2 import SE2
from simulators.device import TURNS_SKIPPED, Beams, CountsTurns, FakeDevice, ManyClients
from simulators.fault_file import Fault
from simulators.faults import Faulty
from simulators.registry import DEVICE_KINDS
from simulators.truth import LMS100, LaserTruth, Ride, seed_of
from simulators.wire import DROPPED, PtyWire
from simulators.world import World

DEFAULT_DEVICES = ("front=sick_lms100", "base=irobot_create")


@dataclass(frozen=True, slots=True)
class DeviceSpec:
    """One device as requested."""

    name: str
    kind: str
    options: BaseModel


def parse_device(text: str) -> DeviceSpec:
    """Read NAME=TYPE[:key=value,...]. Raises ValueError with the reason."""
    name, _, rest = text.partition("=")
    kind, _, options_text = rest.partition(":")
    if not name or kind not in DEVICE_KINDS:
        raise ValueError(
            f"{text!r}: expected NAME=TYPE[:key=value,...] with TYPE one of {', '.join(DEVICE_KINDS)}"
        )
    options: dict[str, str] = {}
    for item in options_text.split(",") if options_text else []:
        key, equals, value = item.partition("=")
        if not equals or key in options:
            raise ValueError(f"{text!r}: {item!r} is not a new key=value")
        options[key] = value
    try:
        return DeviceSpec(name, kind, DEVICE_KINDS[kind].options.model_validate(options))
    except ValidationError as error:
        known = ", ".join(DEVICE_KINDS[kind].options.model_fields)
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
    LaserTruth(Ride(world, 0), "warm-up", SE2(), LMS100, 0).sweep(Beams(0, 27_778, -1.0, 0.01, 200))


class FakeVehicle:
    """Context manager: its devices are on their wires while it is entered. Raises StorageError where a port
    is taken or a link cannot be made."""

    def __init__(self, specs: Sequence[DeviceSpec], ride: Ride, seed: int) -> None:
        self._specs = list(specs)
        self.wires = {
            spec.name: DEVICE_KINDS[spec.kind].build(spec.name, spec.options, ride, seed)
            for spec in self._specs
        }
        self._stack = ExitStack()

    @property
    def devices(self) -> dict[str, FakeDevice | ManyClients]:
        return {name: wire.device for name, wire in self.wires.items()}

    def afflict(self, faults: Sequence[Fault], seed: int, zero_ns: int) -> None:
        """Give each device its faults, timed from host time zero_ns. Call it before it is entered."""
        for name, device in self.devices.items():
            own = [fault for fault in faults if fault.device == name]
            if own:
                assert not isinstance(device, ManyClients), "refused when the faults were read"
                self.wires[name].device = Faulty(device, own, seed_of(seed, f"faults of {name}"), zero_ns)

    def fault_counters(self) -> dict[str, dict[str, int]]:
        """What the faults have done so far, by device."""
        return {
            name: dict(device.counters) for name, device in self.devices.items() if isinstance(device, Faulty)
        }

    def losses(self) -> dict[str, dict[str, int]]:
        """Losses of the simulation so far, by device: turns that this process was too late for, and
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
                    # each plugging in makes another terminal; the link's name stays
                    folder = stack.enter_context(TemporaryDirectory(prefix="corridor-"))
                    wire.link = Path(folder) / name
                try:
                    stack.enter_context(wire)
                except OSError as error:
                    raise StorageError(f"{name}: no wire: {error.strerror or error}") from error
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
