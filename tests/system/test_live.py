"""Fake devices, service, Zenoh, ROS 2, the page and MCAP, each its own process: one whole drive.

Clients without a role try something of each kind meanwhile. All such attempts are in
tests/service/publishing/test_security.py and tests/service/web/test_guards.py.
"""

import asyncio
import json
import math
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
import zenoh

from drivers.rmw_zenoh import Attachment
from drivers.zenoh_callback import daemon_callback
from drivers.zenoh_config import zenoh_config
from service.encoding import (
    decode_diagnostics,
    decode_event,
    decode_frame,
    decode_grid,
    decode_pose,
    encode_pose,
)
from service.encoding.ros_services import TRIGGER, service_hash
from service.mapstore.files import load_map
from service.offline.replay.raw import remake_frames
from service.offline.replay.replay import ReplayOptions, replay
from service.offline.security.authority import Holder, init_site
from service.outputs import UNKNOWN
from service.recording.mcap_reader import Recording
from tests.http_client import client_session
from tests.service.publishing.conftest import HOSTS, tls
from tests.service.recording.sessions import events_of
from tests.service.web.conftest import Client
from tests.system.machine import PATIENCE_S, FakeVehicle, LiveService, Subscriber, free_port
from tests.waiting import wait_until

Subscribe = Callable[..., Subscriber]
ROOT = "corridor/v1/veh1"
FAKE = b"FAKE"
SCAN = "sensor_msgs/msg/LaserScan"
SCANS = 100  # 2 s; the vehicle stands for a second of them at most
FASTEST_MPS = 1.0  # that the fake vehicle drives
REFUSED_MS = 300
WRITTEN = ("front/scan", "base/odom", "pose", "odom", "tf", "tf_static", "map", "graph", "diagnostics")


@pytest.fixture
def site(tmp_path: Path) -> Path:
    holders = [Holder("veh1", "vehicle", HOSTS), Holder("hall", "viewer"), Holder("lost", "viewer")]
    init_site(tmp_path / "site", holders, days=30)
    init_site(tmp_path / "other", [Holder("hall", "viewer")], days=30)
    return tmp_path / "site"


@pytest.fixture
def remote() -> str:
    """Where the service listens to those with a certificate."""
    return f"tls/127.0.0.1:{free_port()}"


@pytest.fixture
def service(fake_vehicle: FakeVehicle, site: Path, remote: str, tmp_path: Path) -> Iterator[LiveService]:
    """It records the wires, too."""
    local = f"tcp/127.0.0.1:{free_port()}"
    security = {"tls": tls(site, "veh1"), "roles": {"viewer": ["hall"], "vehicle": ["veh1"]}}
    live = LiveService(
        tmp_path,
        fake_vehicle.sensors(),
        raw=True,
        listen=[local, remote],
        security=security,
        ros2={"enabled": True},
    )
    live.endpoint = local
    try:
        live.start()
        yield live
    finally:
        live.close()


def test_a_whole_drive(service: LiveService, site: Path, remote: str, subscribe: Subscribe):
    subscriber = subscribe(service.endpoint)
    _wait_for_the_drive(service, subscriber)
    _check_clients_without_a_role_are_refused(service, subscriber, site, remote, subscribe)

    marked = subscriber.ask("mark", text="begin", id="1")
    assert subscriber.ask("mark", text="begin", id="1") == marked
    assert "did you mean 'text'" in subscriber.ask("mark", txt="begin")["error"]

    assert subscriber.ask("pause")["changed"]
    subscriber.wait_for("front/scan", 25)
    subscriber.wait_until(lambda: "health" in subscriber.heard and _state(subscriber) == "paused")
    assert subscriber.ask("resume")["changed"]
    subscriber.wait_for("pose", 25)

    saved = subscriber.ask("save_map")
    first_map = Path(saved["folder"])
    stored = load_map(first_map)
    newest = max(tile.version for tile in stored.tiles)
    assert (stored.number, newest) == (saved["version"], saved["map_version"])

    reset = subscriber.ask("reset_map")
    second_map = Path(f"{first_map}_2")
    assert (reset["folder_before"], reset["folder"]) == (str(first_map), str(second_map))
    before = load_map(first_map)
    subscriber.wait_for("pose", 75)
    fetched = _check_the_old_map_is_gone(subscribe(service.endpoint), before.tiles)

    stopped = subscriber.ask("stop_recording")
    subscriber.wait_for("front/scan", 25)
    started = subscriber.ask("start_recording")
    assert stopped["changed"]
    assert started["changed"]
    _check_ros2(service.endpoint, subscriber)
    subscriber.wait_for("pose", 50)
    words = len(service.systemd.words)
    service.signal(signal.SIGTERM)
    service.signal(signal.SIGINT)  # the second must not stop what the first began
    service.systemd.wait_for("STOPPING=1", after=words)
    assert service.wait() == 0, service.log

    (first,) = [Path(path) for path in stopped["files"]]
    (second,) = [Path(path.removesuffix(".active")) for path in started["files"]]
    assert sorted(service.sessions.iterdir()) == sorted([first, second])
    assert sorted(service.maps.iterdir()) == [first_map, second_map]
    last = {f"map/tile/{t.level}/{t.ix}/{t.iy}": t.version for t in load_map(second_map).tiles}
    heard = {key: max(subscriber.versions.get(key, 0), fetched.get(key, 0)) for key in last}
    assert heard == last  # every tile was sent or fetched, in its last version
    topics = {topic.name for session in (first, second) for topic in Recording([session]).topics}
    assert {f"/{channel}" for channel in WRITTEN} <= topics
    _check_the_commands_stand_in_the_recording(first)
    _check_the_replay_is_the_drive(first)
    _check_the_wires_make_the_frames_again(first, service.sessions.parent)
    _check_a_session_of_its_own(second)


def _wait_for_the_drive(service: LiveService, subscriber: Subscriber) -> None:
    """Until all works as it should."""
    subscriber.wait_for("front/scan", 1)
    first = subscriber.count("front/scan")
    subscriber.wait_for("front/scan", SCANS)
    heard = subscriber.heard
    scans = [decode_frame(SCAN, payload, "front", 0) for _, payload in heard["front/scan"][first:]]
    between_s = np.diff([scan.stamp_ns for scan in scans if scan is not None]) / 1e9
    assert np.median(between_s) == pytest.approx(0.02, rel=0.06)
    subscriber.wait_until(lambda: {"pose", "base/odom", "odom", "tf", "health"} <= heard.keys())
    subscriber.wait_for("pose", max(0, first + SCANS - subscriber.count("pose")))  # one for each scan
    seen = rows(subscriber)
    assert seen["sensor/front"].values["state"] == seen["sensor/base"].values["state"] == "streaming"
    assert {"mapping", "map", "recording", "zenoh", "ros2", "web", "clock"} <= seen.keys()
    service.systemd.wait_for("WATCHDOG=1")
    states = "ok", "overloaded"  # for 10 s after a scan that was dropped under load
    service.systemd.wait_for(tuple(f"STATUS=mapping {state}, 2/2 sensors, " for state in states))
    with urlopen(seen["web"].values["address"], timeout=PATIENCE_S) as page:
        assert b"<title>" in page.read()
    assert "numpy" in service.libraries
    assert "llvmlite" not in service.libraries  # only the mapper's process calls kernels


def rows(subscriber: Subscriber) -> dict[str, Any]:
    """The newest health, by name of the row."""
    return {row.name: row for row in decode_diagnostics(subscriber.heard["health"][-1][1])}


def _state(subscriber: Subscriber) -> str:
    return str(rows(subscriber)["mapping"].values.get("state", ""))


def _check_clients_without_a_role_are_refused(
    service: LiveService, operator: Subscriber, site: Path, remote: str, subscribe: Subscribe
) -> None:
    watching, lost = subscribe(remote, shown(site, "hall")), subscribe(remote, shown(site, "lost"))
    viewer = subscribe(
        remote, shown(site, "hall")
    ).session  # receives its own messages, so another one watches
    tried = {name: attempt() for name, attempt in attempts(remote, site, viewer, lost.session).items()}
    assert [name for name, was_refused in tried.items() if not was_refused] == []
    assert not asyncio.run(command_by_wrong_token(rows(operator)["web"].values["address"]))["ok"]

    assert nothing_comes(viewer, f"{ROOT}/nothing")
    assert [reply.ok for reply in viewer.get(f"{ROOT}/health", timeout=PATIENCE_S)]
    operator.wait_for("pose", 10)
    operator.wait_for("health", 2)
    seen = rows(operator)
    for name in ("zenoh", "ros2", "web", "recording", "map", "commands"):  # others depend on the processor
        assert seen[name].level == 0, seen[name]
    assert seen["commands"].values.get("refused", "0") == "0"
    wait_until(lambda: watching.count("pose") > 0)
    for subscriber in (operator, watching):
        assert FAKE not in [payload for heard in subscriber.heard.values() for _, payload in heard]
    wait_until(lambda: f"{ROOT}/alive/mapping" in alive(watching))  # not while scans are late
    assert f"{ROOT}/alive/thief" not in alive(watching)


def alive(subscriber: Subscriber) -> set[str]:
    tokens = subscriber.session.liveliness().get(f"{ROOT}/alive/*")
    return {str(reply.ok.key_expr) for reply in tokens if reply.ok}


def shown(site: Path, name: str = "") -> dict[str, Any]:
    """Settings of a session that shows the certificate of a name, or none."""
    files = tls(site, name)
    settings = {"root_ca_certificate": files["ca"]}
    if name:
        settings |= {"connect_certificate": files["certificate"], "connect_private_key": files["key"]}
    return {"transport/link/tls": settings | {"enable_mtls": bool(name)}}


def nothing_comes(session: zenoh.Session, key: str, request: dict[str, Any] | None = None) -> bool:
    payload = None if request is None else json.dumps(request)
    return not [reply for reply in session.get(key, payload=payload, timeout=PATIENCE_S) if reply.ok]


def cannot_connect(endpoint: str, site: Path, name: str) -> bool:
    try:
        Subscriber(endpoint, {**shown(site, name), "connect/timeout_ms": REFUSED_MS}).close()
    except zenoh.ZError:
        return True
    return False


def is_disconnected(endpoint: str, sent: bytes) -> bool:
    host, port = endpoint.partition("/")[2].split(":")
    with socket.create_connection((host, int(port)), PATIENCE_S) as client:
        client.sendall(sent)
        with suppress(ConnectionError):
            while client.recv(4096):
                pass
    return True


def attempts(
    endpoint: str, site: Path, viewer: zenoh.Session, lost: zenoh.Session
) -> dict[str, Callable[[], bool]]:
    """lost: with a name that has no role any more."""

    def answer() -> bool:
        replying = daemon_callback(lambda query: query.reply(f"{ROOT}/map", FAKE), "fake")
        viewer.declare_queryable(f"{ROOT}/map", replying, complete=True)
        return True

    put = {
        key: partial(lambda key: viewer.put(key, FAKE) is None, key)
        for key in (f"{ROOT}/pose", f"{ROOT}/initialpose", "0/pose/nav_msgs::msg::dds_::Odometry_/x")
    }
    return {
        "command": partial(nothing_comes, viewer, f"{ROOT}/cmd/stop_recording", {}),
        "call a service of ROS 2": partial(nothing_comes, viewer, "0/corridor/pause/**"),
        **put,
        "answer": answer,
        "be alive": lambda: viewer.liveliness().declare_token(f"{ROOT}/alive/thief") is not None,
        "read without a role": partial(nothing_comes, lost, f"{ROOT}/health"),
        "connect by another authority": partial(cannot_connect, endpoint, site.parent / "other", "hall"),
        "speak no TLS": partial(is_disconnected, endpoint, b"GET / HTTP/1.1\r\n\r\n" + bytes(1000)),
    }


async def command_by_wrong_token(address: str) -> dict[str, Any]:
    async with client_session() as session:
        client = Client(session, address)
        async with client.socket() as page:
            await client.ask(page, type="token", token="wrong")
            await client.ask(page, type="command", n=1, verb="pause")
            return dict((await client.next(page, "answer"))["body"])


def _check_ros2(endpoint: str, subscriber: Subscriber) -> None:
    """A node has the bytes of the native keys, and its requests reach the commands."""
    settings = {"mode": "client", "connect/endpoints": [endpoint], "connect/timeout_ms": 20_000}
    with zenoh.open(zenoh_config(settings)) as node:
        poses = node.declare_subscriber(
            "0/pose/nav_msgs::msg::dds_::Odometry_/*", zenoh.handlers.RingChannel(1)
        )
        payload = poses.recv().payload.to_bytes()
        subscriber.wait_until(lambda: payload in (heard for _, heard in subscriber.heard["pose"]))
        key = f"0/corridor/save/std_srvs::srv::dds_::Trigger_/{service_hash(TRIGGER)}"
        beside = Attachment(1, 1, bytes(16)).encode()
        (reply,) = node.get(key, payload=b"\x00\x01\x00\x00\x00", attachment=beside, timeout=PATIENCE_S)
        assert reply.ok.payload.to_bytes()[4] == 1  # success


def _check_the_old_map_is_gone(late: Subscriber, before: list[Any]) -> dict[str, int]:
    """For a client that joins after the reset each tile is of the new map, or all unknown, and newer.

    Versions by channel.
    """
    last_before = max(tile.version for tile in before)
    fetched = late.get("map/tile/**?since=0")
    assert {f"map/tile/{t.level}/{t.ix}/{t.iy}" for t in before} <= fetched.keys()
    assert all(version > last_before for version, _ in fetched.values())
    emptied = last_before + len(before)
    known = {key for key, (_, payload) in fetched.items() if (decode_grid(payload).cells != UNKNOWN).any()}
    assert known == {key for key, (version, _) in fetched.items() if version > emptied}
    assert len(known) > 3
    return {key: version for key, (version, _) in fetched.items()}


def _check_the_commands_stand_in_the_recording(session: Path) -> None:
    events = events_of(session)
    # Which states it went through is up to the load of the machine; it was paused in any case.
    states = {event["state"] for event in events if event["event"] == "mapping" and event["reason"]}
    assert "paused" in states
    aside = ("start", "sensor", "mapping", "apply_result", "scan_passed_over")
    names = [event["event"] for event in events if event["event"] not in aside]
    # Each save has the graph, and a long drive has checkpoints of its own.
    assert names[names.index("save_map") + 1] == names[names.index("reset_map") - 1] == "checkpoint"
    commands = [name for name in names if name != "checkpoint"]
    assert commands == ["mark", "pause", "resume", "save_map", "reset_map", "stop_recording"]
    assert {"event": "mark", "id": "1", "text": "begin"} in events


def _check_the_replay_is_the_drive(session: Path) -> None:
    recording = Recording([session])
    recorded = [m.payload for m in recording.messages(["/pose"])]
    replayed = replay([session], ReplayOptions())
    again = [encode_pose(output, 0).payload for output in replayed.outputs]
    assert again[: len(recorded)] == recorded
    assert len(again) - len(recorded) <= 5  # of scans that were being mapped when the recording ended
    assert replayed.summary["map_resets"] == 1
    assert replayed.summary["scans_paused"] == len(_scans_between(recording, "pause", "resume")) > 0
    assert replayed.summary["scans_dropped"] == 0
    _check_odom_goes_on_over_the_reset(recording)


def _scans_between(recording: Recording, begin: str, end: str) -> list[int]:
    """Log times of the scans between two events."""
    events = {json.loads(decode_event(m.payload))["event"]: m.log_ns for m in recording.messages(["/events"])}
    log_times_ns = [m.log_ns for m in recording.messages(["/front/scan"])]
    return [log_ns for log_ns in log_times_ns if events[begin] < log_ns < events[end]]


def _check_odom_goes_on_over_the_reset(recording: Recording) -> None:
    events = recording.messages(["/events"])
    reset_ns = next(m.log_ns for m in events if '"reset_map"' in decode_event(m.payload))
    read_ns = {m.stamp_ns: m.log_ns for m in recording.messages(["/front/scan"])}  # by the stamp of a scan
    for topic, jumps in (("/odom", False), ("/pose", True)):
        poses = [(read_ns[m.stamp_ns], decode_pose(m.payload).pose) for m in recording.messages([topic])]
        before_ns, before = [(log_ns, pose) for log_ns, pose in poses if log_ns < reset_ns][-1]
        after_ns, after = next((log_ns, pose) for log_ns, pose in poses if log_ns > reset_ns)
        driven_m = FASTEST_MPS * (after_ns - before_ns) / 1e9
        assert (math.hypot(after.x_m - before.x_m, after.y_m - before.y_m) > 0.2 + driven_m) is jumps


def _check_the_wires_make_the_frames_again(session: Path, folder: Path) -> None:
    remake_frames([session], None, folder / "remade.mcap")
    recording, remade = Recording([session]), Recording([folder / "remade.mcap"])
    for channel in ("/front/scan", "/base/odom"):
        recorded, frames = ([m.payload for m in one.messages([channel])] for one in (recording, remade))
        assert len(recorded) > 200
        assert frames[: len(recorded)] == recorded


def _check_a_session_of_its_own(session: Path) -> None:
    recording = Recording([session])
    counts = {topic.name: topic.count for topic in recording.topics}
    assert counts["/front/scan"] >= 25  # of 50 poses heard since, some are of scans read before it began
    assert counts["/tf_static"] == 1
    assert "sick_lms100" in recording.metadata["config"]["yaml"]
    first, static = (next(iter(recording.messages(topics))) for topics in (None, ["/tf_static"]))
    # A pose in transit when the recording began has an earlier log time.
    assert static.log_ns - first.log_ns < 100_000_000
    replayed = replay([session], ReplayOptions())
    too_old = sum(event["event"] == "scan_passed_over" for event in events_of(session))
    assert len(replayed.outputs) + too_old == counts["/front/scan"]
    assert replayed.outputs[0].pose_map_base.x_m == 0.0  # a map of its own
    first = next(iter(recording.messages(["/front/scan"])))
    assert decode_frame(first.type, first.payload, "front", first.log_ns) is not None
