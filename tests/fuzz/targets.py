"""What reads bytes of others: a function a reader, and bytes that it reads well, from which damage begins.

A reader may refuse by the errors that its docstring names. Anything else that it raises is a fault of ours.
"""

import hashlib
import json
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DriverError
from drivers.link import Session
from service.conversion import CloudConverter, ConversionConfig
from service.encoding import decode_frame, decode_step
from service.encoding.outputs import (
    decode_diagnostics,
    decode_event,
    decode_grid,
    decode_initial_pose,
    decode_pose,
    decode_transforms,
)
from service.encoding.wire import from_ros1
from service.errors import CorridorError
from service.mapstore.files import load_map, save_map
from service.mapstore.manifest import MANIFEST, digest_of
from service.offline.importing.carmen import import_carmen
from service.offline.importing.rosbag import import_rosbag
from service.offline.score.score import read_relations
from service.offline.score.trajectory import read_tum
from service.recording.mcap_reader import Recording
from service.recording.mcap_recovery import recover
from service.web.protocol import RequestError, read_request
from tests.drivers import irobot_bench, lms100, lux, mtig, utm30lx
from tests.service.conversion.messages import cloud
from tests.service.mapstore.tile_makers import graph_of, tile
from tests.service.recording.sessions import drive, write_file

STEP_NS = 1_000_000
READ_BYTES = 300  # that a session is given at once
CDR_TYPES = (
    *(f"sensor_msgs/msg/{name}" for name in ("LaserScan", "Imu", "NavSatFix", "PointCloud2")),
    "sensor_msgs/msg/MultiEchoLaserScan",
    *("nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "std_msgs/msg/String"),
)
DECODERS = (
    decode_pose,
    decode_grid,
    decode_diagnostics,
    decode_transforms,
    decode_event,
    decode_initial_pose,
    lambda payload: decode_step(payload, 0),
)


@dataclass(frozen=True)
class Target:
    """run raises `refusals` alone."""

    run: Callable[[bytes], object]
    seeds: Callable[[], list[bytes]]
    refusals: tuple[type[Exception], ...] = (CorridorError,)

    def __call__(self, data: bytes) -> None:
        with suppress(*self.refusals):
            self.run(data)


def wire(new: Callable[[], Any]) -> Target:
    """The session of a driver, given what a device says. new: it and a fake device, in virtual time."""

    def listen(data: bytes) -> None:
        session: Session = new().session
        for k, at in enumerate(range(0, len(data), READ_BYTES)):
            session.receive_data(data[at : at + READ_BYTES], k * STEP_NS)
            session.tick(k * STEP_NS)
            session.outbox.clear()

    def sent() -> list[bytes]:
        received = bytearray()
        talk = new()
        receive = talk.session.receive_data

        def hear(data: bytes, arrived_ns: int) -> Any:
            received.extend(data)
            return receive(data, arrived_ns)

        talk.session.receive_data = hear
        talk.run(0.3)
        return [bytes(received), bytes(received[:2000])]

    return Target(listen, sent, (DriverError,))


def in_folder(read: Callable[[Path], object], name: str = "file") -> Callable[[bytes], None]:
    """A reader of a file, given its content."""

    def run(data: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(data)
            read(path)

    return run


def of_file(name: str, read: Callable[[Path], object], seeds: Callable[[Path], object]) -> Target:
    """A reader of a file. seeds: writes one that is whole to the path."""

    def written() -> list[bytes]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            seeds(path)
            return [path.read_bytes()]

    return Target(in_folder(read, name), written)


def of_text(name: str, read: Callable[[Path], object], text: str) -> Target:
    return of_file(name, read, lambda path: path.write_text(text))


def read_cdr(data: bytes) -> None:
    """The first byte says of which kind the rest is."""
    kind, payload = data[0] if data else 0, data[1:]
    type_name = CDR_TYPES[kind % len(CDR_TYPES)]
    for decode in (DECODERS[kind % len(DECODERS)], partial(from_ros1, type_name)):
        with suppress(CorridorError):
            decode(payload)
    decode_frame(type_name, payload, "front", 0)


def cdr_messages() -> list[bytes]:
    scans = [bytes([CDR_TYPES.index(m.type)]) + bytes(m.payload) for m in drive(2) if m.type in CDR_TYPES]
    return [*scans, *(bytes([k]) + b"\0\1\0\0" + bytes(60) for k in range(len(CDR_TYPES)))]


def read_mcap(path: Path) -> None:
    for message in Recording([path]).messages():
        with suppress(CorridorError):
            decode_frame(message.type, message.payload, "front", message.log_ns)


def read_stored(path: Path) -> None:
    """A map in which one file is replaced by what is damaged; its checksums fit."""
    data = path.read_bytes()
    name = ("tiles.npz", "graph.npz", "geo.json", MANIFEST)[data[0] % 4] if data else MANIFEST
    folder = path.parent / "map"
    save_map(folder, [tile(0, 0, 1)], 1, {"vehicle": "veh1"}, None, graph_of(3))
    version = folder / "v000001"
    (version / name).write_bytes(data[1:])
    with suppress(ValueError, RecursionError, KeyError, TypeError):  # a manifest without a checksum, too
        manifest = json.loads((version / MANIFEST).read_text())
        manifest.pop("sha256", None)
        if name != MANIFEST:
            digest = hashlib.sha256(data[1:]).hexdigest()
            manifest["files"][name] = {"bytes": len(data) - 1, "sha256": digest}
        (version / MANIFEST).write_text(json.dumps(manifest | {"sha256": digest_of(manifest)}))
    load_map(folder)


def stored_files() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        save_map(Path(folder), [tile(0, 0, 1)], 1, {"vehicle": "veh1"}, None, graph_of(3))
        names = enumerate(("tiles.npz", "graph.npz", "", MANIFEST))
        files = [bytes([k]) + (Path(folder) / "v000001" / name).read_bytes() for k, name in names if name]
    return [*files, b'\2{"datum": "WGS84", "latitude_deg": 1.0, "fixes": 3}']


def write_recording(path: Path) -> None:
    write_file(path, drive(6), sync_every=3)


CARMEN_LOG = (
    "PARAM robot_frontlaser_offset 0.08\n"
    "FLASER 4 1.0 2.5 81.9 4.0 1.0 2.0 0.1 1.1 2.1 0.1 10.1 host 10.1\n"
    "ODOM 1.0 2.0 0.1 0.5 0.0 0.0 10.2 host 10.2\n"
    "ROBOTLASER1 0 -1.57 3.14 1.0 80.0 0.01 0 3 1.0 2.0 3.0 0 1 2 0.1 1 2 0.1 0 0 0.5 0.3 1e6 10.3 "
    "host 10.3\n"
)
ASKED = [
    b'{"type": "command", "id": "1", "verb": "mark_event", "request": {"text": "a"}}',
    b'{"type": "token", "token": "x"}',
    b'{"type": "resource", "path": "maps"}',
]

TARGETS: dict[str, Target] = {
    "sopas": wire(lms100.talk),
    "scip": wire(utm30lx.talk),
    "lux": wire(lux.talk),
    "mti": wire(lambda: mtig.talk(mtig.legacy())),
    "mtdata2": wire(lambda: mtig.talk(mtig.mtdata2())),
    "create": wire(irobot_bench.bench),
    "cdr": Target(read_cdr, cdr_messages),
    "cloud": Target(
        lambda data: CloudConverter(ConversionConfig(), np.eye(4)).scan(data, "front", 0),
        lambda: [cloud(dict.fromkeys("xyz", np.arange(1.0, 50.0)))],
    ),
    "mcap": of_file("a.mcap", read_mcap, write_recording),
    "recovery": of_file("a.mcap", recover, write_recording),
    "maps": Target(in_folder(read_stored), stored_files),
    "carmen": of_text("a.log", lambda path: import_carmen(path, path.with_suffix(".mcap")), CARMEN_LOG),
    "import": of_file("a.mcap", lambda path: import_rosbag(path, path.with_name("b.mcap")), write_recording),
    "relations": of_text("a.relations", read_relations, "1.0 2.0 0.5 0.1 0.0 0.0 0.0 0.2\n" * 3),
    "tum": of_text("a.tum", read_tum, "1.0 2.0 0.5 0.0 0.0 0.0 0.0 1.0\n2.0 2.0 0.5 0.0 0.0 0.0 0.0 1.0\n"),
    "asked": Target(
        lambda data: read_request(data.decode(errors="replace")), lambda: list(ASKED), (RequestError,)
    ),
}
