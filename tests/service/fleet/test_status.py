"""`corridor fleet router|status|watch` as one calls them, with sinks of vehicles on loopback."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh

from service.config import load_publishing
from service.encoding import ERROR, WARNING, Status, encode_diagnostics, encode_pose
from service.errors import StorageError
from service.fleet import vehicles as vehicles_module
from service.fleet.router import zenohd_config
from service.fleet.vehicles import Vehicle, read_vehicles
from service.fleet.watch import Watch
from service.offline.security.authority import Holder, init_site
from service.publishing.config import PublishingConfig
from service.publishing.session import open_session as open_router
from service.publishing.uplink import open_client as open_client_of
from tests.service.cli.test_commands import code_of
from tests.service.fleet.conftest import diagnostics, router_config
from tests.service.publishing.conftest import tls
from tests.service.test_encoding_outputs import OUTPUT
from tests.system.machine import free_port
from tests.waiting import wait_until


def vehicles_at(capsys, site_file, *names: str) -> tuple[int, dict[str, dict]]:
    code = code_of(["fleet", "status", "--site", site_file, "--json", *names])
    return code, {one["name"]: one for one in json.loads(capsys.readouterr().out)["vehicles"]}


def put_health(sink, client, vehicle: str = "veh1", clock_off_s: int = 0) -> None:
    """And wait until it is the answer to a get."""
    sink.put(diagnostics(stamp_ns=time.time_ns() + clock_off_s * 1_000_000_000))
    wait_until(lambda: list(client.get(f"corridor/v1/{vehicle}/health", timeout=20.0)))


def test_status_lists_each_vehicle_with_what_it_says_of_itself(
    endpoint, start_vehicle, client, site_file, capsys
):
    for name in ("veh2", "veh1"):
        sink = start_vehicle(endpoint, name)
        sink.put(encode_pose(OUTPUT, 1))
        put_health(sink, client, name)
    code, vehicles = vehicles_at(capsys, site_file)
    assert (code, list(vehicles)) == (0, ["veh1", "veh2"])
    veh1 = vehicles["veh1"]
    assert (veh1["state"], veh1["map"], veh1["map_version"]) == ("ok", "site", 7)
    assert (veh1["free_gb"], veh1["corridor"]) == (12.5, "0.1.0")
    pose = OUTPUT.pose_map_base
    assert veh1["x_m"] == pytest.approx(pose.x_m, abs=1e-3)
    assert len(veh1["sessions"]) == 1
    assert code_of(["fleet", "status", "--site", site_file]) == 0
    assert "veh1: ok | x " in capsys.readouterr().out


@pytest.mark.parametrize(("off_s", "is_well"), [(-86_400, False), (0, True), (86_400, False)])
def test_a_vehicle_whose_clock_is_a_day_off_is_not_well(
    off_s, is_well, endpoint, router, start_vehicle, open_client
):
    put_health(start_vehicle(endpoint), open_client(endpoint), clock_off_s=off_s)
    (vehicle,) = read_vehicles(open_client(endpoint))
    assert vehicle.is_well is is_well
    assert vehicle.age_s == pytest.approx(-off_s, abs=30.0)
    assert any("is its clock right" in one for one in vehicle.faults) is not is_well


def test_a_vehicle_that_waits_in_vain_for_its_first_scan_is_not_well(
    endpoint, start_vehicle, client, site_file, capsys
):
    start_vehicle(endpoint).put(diagnostics("waiting", level=ERROR))
    wait_until(lambda: list(client.get("corridor/v1/veh1/health", timeout=20.0)))
    code, vehicles = vehicles_at(capsys, site_file)
    assert (code, vehicles["veh1"]["is_well"]) == (1, False)


def test_a_router_that_does_not_answer_is_told_with_what_to_look_at(site):
    tls_only = {"connect": (f"tls/127.0.0.1:{free_port()}",), "security": {"tls": tls(site, "viewer")}}
    with pytest.raises(StorageError, match="is it running, and are the certificates of both valid"):
        open_client_of(PublishingConfig.model_validate(tls_only))


def test_what_is_no_health_message_is_a_fault_of_its_vehicle(endpoint, router, open_client):
    client = open_client(endpoint)

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply("corridor/v1/veh5/health", b"\0\1\0\0nonsense")

    client.declare_queryable("corridor/v1/veh5/health", answer)
    (vehicle,) = read_vehicles(open_client(endpoint), ["veh5"])
    assert vehicle.state == "silent"
    assert "cannot be read" in vehicle.faults[0]


def watched(client: zenoh.Session) -> tuple[Watch, threading.Thread, list[Vehicle]]:
    """What the watch shows of changes, for a minute at most."""
    seen: list[Vehicle] = []
    watch = Watch(client)
    thread = threading.Thread(target=watch.run, args=(seen.append, 60.0, True), daemon=True)
    thread.start()
    return watch, thread, seen


def test_watch_shows_changes_and_a_vehicle_that_goes(endpoint, router, start_vehicle, open_client):
    sink = start_vehicle(endpoint)
    put_health(sink, open_client(endpoint))
    _, _, seen = watched(open_client(endpoint))
    wait_until(lambda: seen)
    wait_until(lambda: sink.put(diagnostics("lost")) or seen[-1].state == "lost")
    sink.close()
    wait_until(lambda: seen[-1].state == "silent")
    assert [one.state for one in seen if one.sessions] == ["ok", "lost"]


def test_watch_passes_over_a_fault_whose_figures_alone_change(endpoint, router, start_vehicle, open_client):
    sink = start_vehicle(endpoint)
    put_health(sink, open_client(endpoint))
    watch, thread, seen = watched(open_client(endpoint))
    words = [f"{count} scans in {count}.5 s were not mapped" for count in (3, 14)]
    silent = [f"no scan of laser_{number} comes" for number in (1, 2)]
    for expected, fault in zip((words[0], words[0], *silent), (*words, *silent), strict=True):
        row = Status("mapping", WARNING, fault, {"state": "overloaded"})
        health = encode_diagnostics("diagnostics", [row], time.time_ns(), time.time_ns())
        heard = threading.Event()
        client = open_client(endpoint)
        client.declare_subscriber("corridor/v1/veh1/health", lambda sample, heard=heard: heard.set())
        wait_until(lambda heard=heard, health=health: sink.put(health) or heard.is_set())
        wait_until(lambda expected=expected: any(expected in "".join(one.faults) for one in seen))
    watch.close()
    thread.join(20.0)
    assert [one.faults[0].rpartition(": ")[2] for one in seen if one.faults] == [words[0], *silent]


@contextmanager
def router_process(endpoint: str, folder: Path) -> Iterator[subprocess.Popen[str]]:
    path = folder / "router.yaml"
    path.write_text(f"publishing: {{listen: [{endpoint}]}}\n")
    command = [sys.executable, "-m", "service", "fleet", "router", str(path), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert json.loads(process.stdout.readline())["listen"] == [endpoint]
            yield process
        finally:
            process.kill()


def test_a_router_that_does_not_say_who_is_there_is_an_error_and_no_empty_fleet(
    endpoint, start_vehicle, site_file, tmp_path, monkeypatch
):
    """It runs until SIGTERM."""
    monkeypatch.setattr(vehicles_module, "ANSWER_S", 0.5)
    with router_process(endpoint, tmp_path) as process:
        start_vehicle(endpoint)
        with vehicles_module.connected(load_publishing(Path(site_file))) as session:
            process.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, process.pid, os.WSTOPPED)  # all of its threads stand
            with pytest.raises(StorageError, match="did not say within"):
                vehicles_module.present(session)
            process.send_signal(signal.SIGCONT)
            wait_until(lambda: list(vehicles_module.present(session)) == ["veh1"])
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 0


@pytest.mark.parametrize(
    ("hosts", "is_other", "words"),
    [
        (("site.example",), False, "IP address mismatch, .* '127.0.0.1'"),
        (("127.0.0.1",), True, "unable to get"),
    ],
)
def test_a_client_says_why_it_refuses_the_certificate_of_a_router(endpoint, tmp_path, hosts, is_other, words):
    """Zenoh reports a time-out."""
    secured = endpoint.replace("tcp", "tls")
    init_site(tmp_path, [Holder("router", "operator", hosts), Holder("anna", "operator")], 30)
    files = tls(tmp_path, "anna")
    if is_other:
        init_site(tmp_path / "other", [Holder("anna", "operator")], 30)
        files = tls(tmp_path / "other", "anna")
    listen = {"listen": [secured], "security": {"tls": tls(tmp_path, "router")}}
    router = open_router(PublishingConfig.model_validate(listen))
    try:
        config = PublishingConfig.model_validate({"connect": [secured], "security": {"tls": files}})
        with pytest.raises(StorageError, match=f"does not accept its certificate: {words}"):
            open_client_of(config)
    finally:
        router.close()


def test_a_router_whose_certificate_has_expired_says_so(endpoint, tmp_path):
    init_site(tmp_path, [Holder("router", "operator", ())], 30, now=datetime.now(UTC) - timedelta(days=40))
    security = {"tls": tls(tmp_path, "router")}
    path = tmp_path / "router.yaml"
    path.write_text(json.dumps({"publishing": {"listen": [endpoint], "security": security}}))
    command = [sys.executable, "-m", "service", "fleet", "router", str(path)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert "router.pem is valid from" in process.stderr.readline()
        finally:
            process.kill()


def test_the_config_for_zenohd_refuses_unknown_clients_and_viewers_as_our_router_does(
    site, endpoint, client_of, open_session, start_vehicle, tmp_path
):
    secured = endpoint.replace("tcp", "tls")
    path = tmp_path / "zenohd.json5"
    path.write_text(zenohd_config(router_config(site, secured)))
    open_session(zenoh.Config.from_file(str(path)))  # zenohd reads the file by the same code
    start_vehicle(secured)
    with pytest.raises(zenoh.ZError):
        client_of(secured, timeout_ms=500)
    key = "corridor/v1/veh1/cmd/any"
    assert list(client_of(secured, "operator").get(key, timeout=20.0))
    assert not list(client_of(secured, "viewer").get(key, timeout=20.0))
