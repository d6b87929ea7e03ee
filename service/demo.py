"""Fake devices and the real service on one machine, and how well it mapped: the truth is known here."""

import json
import logging
import math
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml
from pydantic import ValidationError

from service.compile.warm_up import KernelProgress, warm_up
from service.config import ServiceConfig, parse_config
from service.encoding import LASER_SCAN, decode_frame, decode_pose
from service.encoding import warm_up as warm_up_encoding
from service.encoding.steps import LOAD_MAP, SWITCH_PROFILE, decode_step
from service.errors import ConfigError, CorridorError, StorageError
from service.geometry.se2 import SE2
from service.mapper.mapping_session import LoadMap, SessionRequest, Step, SwitchProfile
from service.mapper.profiles import MappingConfig, mapping_config
from service.recording.mcap_reader import Recording
from service.runtime.run import run
from service.runtime.service import Service
from service.runtime.summary import Summary
from service.web.access import token_from_file
from service.writable import make_writable

log = logging.getLogger(__name__)

VEHICLE = "veh1"  # as in the samples of README and docs
ZENOH_PORT = 7447
WEB_PORT = 8080
DEFAULT_WORLD = "office"
STAND_S = 4.0  # the vehicle waits so long; the drivers log in meanwhile, and the map begins where it stands
END_TIMEOUT_S = 30.0  # the simulators tell at their end what they left out
READY_TIMEOUT_S = 120.0  # the simulators compile their ray caster first
DEVICES: dict[str, tuple[str, dict[str, float]]] = {  # name -> type and mounting
    "front": ("sick_lms100", {"x_m": 0.20, "y_m": 0.0, "yaw_deg": 0.0}),
    "rear": ("hokuyo_utm30lx", {"x_m": -0.20, "y_m": 0.0, "yaw_deg": 180.0}),
    "lux": ("ibeo_lux", {"x_m": 0.25, "y_m": 0.0, "yaw_deg": 0.0}),
    "imu": ("xsens_mtig", {"x_m": 0.0, "y_m": 0.0, "yaw_deg": 0.0}),
    "base": ("irobot_create", {}),
}

LATEST_POSE_NS = 2_000_000_000  # after its scan: older ones are not mapped
NO_ERROR: dict[str, float | None] = {"position_rmse_m": None, "heading_rmse_deg": None}  # it is not known

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DemoOptions:
    seconds: float | None  # None: until a signal
    world: str | None
    profile: str | None
    seed: int
    out: Path
    faults: Path | None = None
    web: bool = True
    port: int | None = None  # of Zenoh; None: the usual one, or any that is free
    web_port: int | None = None  # of the operator's page; likewise


@dataclass(frozen=True, slots=True)
class Page:
    """The operator's page: where it will be, and what gives the right to command."""

    listen: str
    token_file: Path
    token: str


@dataclass(frozen=True, slots=True)
class LastMap:
    """The poses in the map that a run ended with."""

    began: str  # the command that began it; "" where the run had no other
    stamps_ns: npt.NDArray[np.int64]  # (N,) host monotonic
    poses: list[SE2]  # N, in the map


class Simulators:
    """The fake devices, in a process of their own."""

    def __init__(self, process: subprocess.Popen[bytes], endpoints: list[dict[str, str]]) -> None:
        self._process = process
        self.endpoints = endpoints
        self.left_out: dict[str, int] = {}  # measurements not sent, by device; known at the end

    def fault(self) -> str:
        """Why the demo cannot go on, "" while they run."""
        code = self._process.poll()
        return "" if code is None else f"the simulators ended with exit code {code}"


def demo(
    options: DemoOptions,
    compiling: Callable[[], AbstractContextManager[KernelProgress | None]] = nullcontext,
    watch: Callable[[Service], None] = lambda service: None,
    say: Callable[[str], Any] = sys.stderr.write,
) -> dict[str, Any]:
    """Run the demo; its summary, for JSON. Raises CorridorError and its kin where it does not begin.

    compiling   opened while kernels are compiled, and called with each; left out, the log says how far it is
    watch       called several times a second while the service starts and runs
    say         given the line with the address of the page, once it is served
    """
    make_writable(options.out)
    zenoh_port = free_port(options.port, ZENOH_PORT, "--port")
    page = _page(options) if options.web else None
    _mapping(options)  # imports what calls the kernels of the profile
    with compiling() as kernels:  # before the vehicle drives: the map shall begin where it stands
        warm_up_encoding()
        warm_up(progress=kernels)
    log.info("starting the fake devices in the world %s", options.world or DEFAULT_WORLD)
    truth = options.out / "truth.txt"
    is_reported = False

    def look(service: Service) -> None:
        nonlocal is_reported
        if page is not None and not is_reported and (address := service.places.get("web", "")):
            is_reported = True
            say(f"The map, live: {address}#token={page.token}\n")
        watch(service)

    with simulators(options, truth) as fakes:
        config = demo_config(fakes.endpoints, options, zenoh_port, page)
        summary = run(config, options.seconds, options.out / "map", _tell_where_to_look, fakes.fault, look)
        is_truth_whole = not fakes.fault()
    mapped = last_map(summary)
    error = pose_error(mapped, truth) if is_truth_whole else NO_ERROR
    return {
        "seconds": round(summary.seconds, 1),
        "scans": summary.scans,
        "scans_dropped": summary.scans_dropped,
        **error,
        "latency_ms": summary.latency_ms.as_dict(),
        "scan_cpu_ms": summary.scan_cpu_ms.as_dict(),
        "rates_hz": summary.rates_hz,
        "cpu_percent": summary.cpu_percent,
        "void": _void(fakes.left_out, mapped.began),
        "session": str(summary.sessions[-1]) if summary.sessions else None,
        "map": str(summary.map_folder) if summary.map_folder else None,
        "failure": summary.failure or None,
    }


def _mapping(options: DemoOptions) -> MappingConfig:
    try:
        return mapping_config({"profile": options.profile} if options.profile else {})
    except ValidationError as error:
        raise ConfigError([f"--profile: {error.errors()[0]['msg'].removeprefix('Value error, ')}"]) from error


@contextmanager
def simulators(options: DemoOptions, truth: Path) -> Iterator[Simulators]:
    """Start them, wait until every device answers, and end them afterwards.

    Raises CorridorError when they do not come up, ConfigError where the faults are refused.
    """
    command = [sys.executable, "-m", "simulators", "--print-endpoints", "--die-with-parent"]
    command += ["--truth", str(truth), "--seed", str(options.seed), "--stand-s", str(STAND_S)]
    for name, (kind, mounting) in DEVICES.items():
        where = ",".join(f"{key}={value}" for key, value in mounting.items())
        command += ["--device", f"{name}={kind}:{where}" if where else f"{name}={kind}"]
    command += ["--world", options.world or DEFAULT_WORLD]
    if options.faults is not None:
        command += ["--faults", str(options.faults)]
    # A session of its own: Ctrl-C is for the service, which wants its devices until it has stopped.
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        bufsize=0,  # a line that waits in a buffer of ours is invisible to select
        start_new_session=True,
    )
    fakes = None
    try:
        fakes = Simulators(process, _read_endpoints(process))
        yield fakes
    finally:
        process.terminate()
        try:
            process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            last_words = process.stdout.read()
            process.stdout.close()
            if fakes is not None:
                fakes.left_out = left_out_of(last_words)


def demo_config(
    endpoints: Sequence[dict[str, str]], options: DemoOptions, zenoh_port: int, page: Page | None = None
) -> ServiceConfig:
    """The config a user would write for these devices; it goes into the recording like any other.

    page    None: no operator's page is served
    """
    sensors: dict[str, Any] = {}
    for endpoint in endpoints:
        sensor: dict[str, Any] = {"type": endpoint["device"]}
        where = endpoint["endpoint"]
        if where.startswith("tcp://"):
            host, _, port = where.removeprefix("tcp://").rpartition(":")
            sensor |= {"host": host, "port": int(port)}
        else:
            sensor["device"] = where
        if mounting := DEVICES[endpoint["name"]][1]:
            sensor["mounting"] = mounting
        sensors[endpoint["name"]] = sensor
    out = str(options.out)
    text = yaml.safe_dump(
        {
            "vehicle": VEHICLE,
            "sensors": sensors,
            "mapping": {"profile": options.profile} if options.profile else {},
            "publishing": {"listen": [f"tcp/127.0.0.1:{zenoh_port}"]},
            "recording": {"directory": out, "keep_free_gb": 0.2},
            "map": {"directory": out},
            "web": {"enabled": False}
            if page is None
            else {"listen": page.listen, "token_file": str(page.token_file)},
        },
        sort_keys=False,
    )
    return parse_config(text, "config of the demo")


def last_map(summary: Summary) -> LastMap:
    """From the recording. A pose is recorded after its scan, so the first ones behind the command that began
    the map may be of the map before.
    """
    began = ""
    stamps_ns: list[int] = []
    poses: list[SE2] = []
    before_ns: set[int] = set()  # stamps of scans that came before the command
    recording = Recording(summary.sessions) if summary.sessions else None
    for message in recording.messages(["/pose", "/events"]) if recording else ():
        if message.channel == "pose":
            pose = decode_pose(message.payload)
            if pose.stamp_ns not in before_ns:
                stamps_ns.append(pose.stamp_ns)
                poses.append(pose.pose)
        elif verb := _begins_a_map(decode_step(message.payload, message.log_ns)):
            assert recording is not None
            began, stamps_ns, poses = verb, [], []
            before_ns = _stamps_of_scans(recording, message.log_ns - LATEST_POSE_NS, message.log_ns)
    return LastMap(began, np.array(stamps_ns, dtype=np.int64) - summary.utc_offset_ns, poses)


def _begins_a_map(step: Step | None) -> str:
    """The command with which a map begins; "" for another step."""
    match step:
        case SessionRequest("reset_map"):
            return step.action
        case LoadMap():
            return LOAD_MAP
        case SwitchProfile():
            return SWITCH_PROFILE
    return ""


def _stamps_of_scans(recording: Recording, from_ns: int, to_ns: int) -> set[int]:
    lasers = [topic.name for topic in recording.topics if topic.type == LASER_SCAN]
    frames = (
        decode_frame(m.type, m.payload, m.channel, m.log_ns)
        for m in recording.messages(lasers, from_ns, to_ns)
    )
    return {frame.stamp_ns for frame in frames if frame is not None}


def pose_error(mapped: LastMap, truth: Path) -> dict[str, float | None]:
    """RMSE of the poses of a map against the truth, both taken from where the first pose was.

    None where nothing was mapped, or where it was in a stored map: that may lie anywhere in the world.
    """
    if not mapped.poses or mapped.began == LOAD_MAP:
        return NO_ERROR
    poses = mapped.poses
    true = interpolate(np.loadtxt(truth, ndmin=2), mapped.stamps_ns)
    first_true, first = true[0].inverse(), poses[0].inverse()
    errors = [(first_true @ t).inverse() @ (first @ p) for t, p in zip(true, poses, strict=True)]
    square_m2 = np.mean([e.x_m**2 + e.y_m**2 for e in errors])
    square_rad2 = np.mean([e.theta_rad**2 for e in errors])
    return {
        "position_rmse_m": round(math.sqrt(square_m2), 4),
        "heading_rmse_deg": round(math.degrees(math.sqrt(square_rad2)), 3),
    }


def interpolate(truth: FloatArray, stamps_ns: npt.NDArray[np.int64]) -> list[SE2]:
    """Poses at stamps, linear between the rows of truth (N, 4): stamp ns, x m, y m, theta rad.

    Raises CorridorError where the truth does not reach.
    """
    known_ns = truth[:, 0]
    if stamps_ns.min() < known_ns[0] or stamps_ns.max() > known_ns[-1]:
        raise CorridorError(
            f"the truth covers {known_ns[0]:.0f} to {known_ns[-1]:.0f} ns, the poses "
            f"{stamps_ns.min()} to {stamps_ns.max()}; were the simulators ended too early?"
        )
    x, y = (np.interp(stamps_ns, known_ns, truth[:, column]) for column in (1, 2))
    theta = np.interp(stamps_ns, known_ns, np.unwrap(truth[:, 3]))
    return [SE2(*pose) for pose in zip(x.tolist(), y.tolist(), theta.tolist(), strict=True)]


def _read_endpoints(process: subprocess.Popen[bytes]) -> list[dict[str, str]]:
    assert process.stdout is not None
    endpoints: list[dict[str, str]] = []
    deadline_s = time.monotonic() + READY_TIMEOUT_S
    while True:
        ready, _, _ = select.select([process.stdout], [], [], max(deadline_s - time.monotonic(), 0.0))
        line = process.stdout.readline() if ready else b""
        if ready and not line and process.wait(READY_TIMEOUT_S) == ConfigError.exit_code:
            raise ConfigError(["the simulators refused the file of faults; what is wrong stands above"])
        if not line:
            state = "ended" if ready else f"sent nothing for {READY_TIMEOUT_S:.0f} s"
            raise CorridorError(f"the simulators {state} before they were ready; their log stands above")
        word = json.loads(line)
        if word.get("ready"):
            return endpoints
        endpoints.append(word)


def left_out_of(last_words: bytes) -> dict[str, int]:
    for line in last_words.splitlines():
        word = json.loads(line)
        if "left_out" in word:
            return dict(word["left_out"])
    return {}


def _void(left_out: dict[str, int], began: str) -> str | None:
    """Why the figures of the demo say nothing; None where they do.

    began   the command that began the last map, "" where it is the only one
    """
    reasons = []
    if left_out:
        missing = ", ".join(f"{count} of {name}" for name, count in left_out.items())
        reasons.append(f"the fake devices had no processor to send {missing}; latency and error are void")
    if began == LOAD_MAP:
        reasons.append("a stored map was loaded, whose place in the world is not known; the error is void")
    return "; ".join(reasons) or None


def free_port(wanted: int | None, usual: int, option: str) -> int:
    """The port of 127.0.0.1 that is wanted; where none is, the usual one, or a free one where that is taken.

    Raises StorageError where the port that is wanted is taken.
    """
    if wanted is None and not _is_free(usual):
        log.warning("port %d is taken; another one is used, %s chooses which", usual, option)
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port: int = probe.getsockname()[1]
            return port
    port = usual if wanted is None else wanted
    if not _is_free(port):
        raise StorageError(
            f"port {port} of 127.0.0.1 is taken, perhaps by another corridor; stop that, or give another "
            f"one by {option}"
        )
    return port


def _page(options: DemoOptions) -> Page:
    """Raises StorageError where its port is taken or the token cannot be kept."""
    port = free_port(options.web_port, WEB_PORT, "--web-port")
    token_file = options.out / "web.token"
    return Page(f"127.0.0.1:{port}", token_file, token_from_file(token_file))


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True


def _tell_where_to_look(service: Service) -> None:
    where = service.places["zenoh"]
    log.info("poses: subscribe to corridor/v1/%s/pose at %s as a Zenoh client, for instance", VEHICLE, where)
    log.info("stop with Ctrl-C; the map is then in the folder named above, as map.png and map.yaml")
