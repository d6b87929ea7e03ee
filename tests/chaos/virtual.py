"""The demo's devices with their drivers and the mapper in virtual time: no wire, no process, no clock.

The load of the machine does not change it, so each run is the same. Each scan has its state.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from drivers.frames import Frame, GnssFix, LaserScan
from service.demo import DEVICES, STAND_S
from service.geometry.se2 import SE2
from service.mapper.mapping_session import MappingSession
from service.mapper.profiles import build_mapper, mapping_config
from service.sensor_kinds import SENSOR_KINDS
from simulators.fault_file import parse_faults
from simulators.faults import Faulty
from simulators.run import TRUTH_STEP_NS
from simulators.truth import Ride
from simulators.vehicle import FakeVehicle, parse_devices
from simulators.wire import PtyWire
from simulators.world import World
from simulators.worlds import build_world
from tests.chaos.judge import DEVICES as CHANNELS
from tests.chaos.judge import Evidence
from tests.drivers.faulty_devices import ZERO_NS
from tests.drivers.virtual_link import VirtualLink

LASER = "front"  # that is mapped


@dataclass(frozen=True)
class VirtualDrive:
    evidence: Evidence
    truth: npt.NDArray[np.float64]  # (N, 4) stamp ns, x m, y m, theta rad


def drive(lines: str, seconds: float, seed: int) -> VirtualDrive:
    """lines: of a file of faults, whose times count from ZERO_NS, when the vehicle begins to stand."""
    ride = Ride(_office(), ZERO_NS, STAND_S)
    frames = [frame for link in _links(lines, ride, seed) for frame in _received(link, seconds)]
    found = Evidence()
    for frame in frames:
        channel = next(one for one in CHANNELS if one.startswith(f"{frame.sensor}/"))
        found.stamps[channel].append(frame.stamp_ns)
        found.arrivals[channel].append(frame.arrived_ns)
        found.logged.append(frame.arrived_ns)
    _, mounting = DEVICES[LASER]
    mountings = {LASER: SE2(mounting["x_m"], mounting["y_m"], 0.0)}
    session = MappingSession(lambda: build_mapper(mapping_config({}), mountings), [LASER])
    for frame in sorted(frames, key=lambda one: one.arrived_ns):
        if isinstance(frame, LaserScan) and frame.sensor != LASER:
            continue
        if (output := session.process(frame)) is not None:
            found.poses.append((0, output.stamp_ns, output.pose_map_base))
            found.states.append((output.stamp_ns, output.state))
            found.arrivals["pose"].append(frame.arrived_ns)
    stamps_ns = np.arange(ZERO_NS - 10**9, ZERO_NS + round(seconds * 1e9), TRUTH_STEP_NS)
    return VirtualDrive(found, np.column_stack((stamps_ns, ride.poses(stamps_ns))))


@cache
def _office() -> World:
    return build_world("office")


def _links(lines: str, ride: Ride, seed: int) -> list[VirtualLink]:
    specs = parse_devices([f"{name}={kind}" for name, (kind, _) in DEVICES.items()])
    vehicle = FakeVehicle(specs, ride, seed)
    faults = parse_faults(f"faults:\n{lines}", "faults", vehicle.devices) if lines else []
    links = []
    for number, (name, (kind, _)) in enumerate(DEVICES.items()):
        wire = vehicle.wires[name]
        own = [fault for fault in faults if fault.device == name]
        where = {"device": "/dev/x"} if isinstance(wire, PtyWire) else {"host": "x"}
        config = SENSOR_KINDS[kind].config.model_validate({"type": kind, "name": name, **where})
        device = Faulty(vehicle.devices[name], own, seed + number, ZERO_NS)
        links.append(VirtualLink(SENSOR_KINDS[kind].session_maker(config), device, ZERO_NS))
    return links


def _received(link: VirtualLink, seconds: float) -> list[Frame]:
    """Without fixes, which do not change the map."""
    link.run(seconds)
    return [frame for frame in link.passed_on if not isinstance(frame, GnssFix)]
