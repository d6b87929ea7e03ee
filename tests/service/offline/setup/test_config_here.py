import threading
from pathlib import Path

import numpy as np
import pytest

from service.config import ServiceConfig, parse_config
from service.mapstore.files import save_map
from service.offline.setup import config_here
from service.offline.setup.config_here import faults_here, known_addresses
from service.outputs import TileUpdate
from tests.service.mapstore.tile_makers import graph_of


def config_of(sensors: str, load: Path | None = None) -> ServiceConfig:
    begin = f", load: '{load}'" if load is not None else ""
    return parse_config(
        f"vehicle: v\nsensors:\n{sensors}\nrecording: {{directory: s}}\nmap: {{directory: m{begin}}}\n",
        "v.yaml",
    )


FRONT = "  front: {type: sick_lms100, host: localhost}"


def test_a_link_and_its_target_are_one_device(tmp_path: Path):
    port = tmp_path / "ttyUSB0"
    port.touch()
    (tmp_path / "create").symlink_to(port)
    (tmp_path / "by-id").symlink_to("create")
    imu = f"  imu: {{type: xsens_mtig, device: {tmp_path / 'by-id'}}}"
    sensors = f"{imu}\n  base: {{type: irobot_create, device: {port}}}"
    assert faults_here(config_of(sensors), "v.yaml") == [
        f"v.yaml:4:31: sensors.base.device: this is {port}, as is that of imu; two sensors cannot share a "
        "device: give each its own, or take one out"
    ]
    (tmp_path / "by-id").unlink()
    assert faults_here(config_of(sensors), "v.yaml") == []  # udev makes the link when the device comes


def test_a_name_and_its_address_are_one_device():
    rear = "  rear: {type: sick_lms100, host: 127.0.0.1}"
    (fault,) = faults_here(config_of(f"{FRONT}\n{rear}"), "v.yaml")
    assert fault.startswith("v.yaml:4:29: sensors.rear.host: this is 127.0.0.1:2111, as is that of front; ")
    other_port = rear.replace("}", ", port: 2112}")
    assert faults_here(config_of(f"{FRONT}\n{other_port}"), "v.yaml") == []


@pytest.mark.parametrize(
    ("wire", "other", "key"),
    [
        ("host: localhost, port: 4001", 'host: "::1", port: 4001', "host"),
        ("host: 127.0.0.1, port: 4001", 'host: "::1", port: 4001', "host"),
        ("host: 127.0.0.1, port: 4001", "host: 0.0.0.0, port: 4001", "host"),
        ("host: LocalHost, port: 4001", "device: 'socket://127.0.0.1:4001'", "device"),
        ("device: 'socket://localhost:4001'", "device: 'RFC2217://[::1]:4001?timeout=3'", "device"),
        ("device: 'socket://localhost:4001'", "host: 127.0.0.1, port: 4001", "host"),
    ],
)
def test_a_device_of_this_machine_is_one_however_it_is_called(wire: str, other: str, key: str):
    sensors = [
        f"{{type: {'sick_lms100' if one.startswith('host') else 'xsens_mtig'}, {one}}}"
        for one in (wire, other)
    ]
    (fault,) = faults_here(config_of(f"  first: {sensors[0]}\n  second: {sensors[1]}"), "v.yaml")
    assert f"sensors.second.{key}: this is 127.0.0.1:4001, as is that of first; " in fault


def test_a_relative_path_and_an_absolute_one_are_one_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "port").touch()
    imu = "  imu: {type: xsens_mtig, device: port}"
    (fault,) = faults_here(config_of(f"{imu}\n  base: {{type: irobot_create, device: ./port}}"), "v.yaml")
    assert f"this is {tmp_path / 'port'}, as is that of imu; " in fault


def test_a_name_server_that_is_silent_is_not_waited_for(monkeypatch: pytest.MonkeyPatch):
    answered = threading.Event()
    monkeypatch.setattr(config_here, "NAME_TIMEOUT_S", 0.01)
    monkeypatch.setattr(config_here.socket, "getaddrinfo", lambda *_, **__: answered.wait() and [])
    try:
        assert known_addresses("lms.local") == {"lms.local"}
    finally:
        answered.set()


def test_a_name_that_no_one_knows_is_itself():
    assert known_addresses("a..b") == {"a..b"}


def test_the_map_to_load_is_read(tmp_path: Path):
    """As a session reads it that begins in it."""
    office = tmp_path / "office"
    (fault,) = faults_here(config_of(FRONT, office), "v.yaml")
    assert fault == (
        f"v.yaml:5:21: map.load: {office}: no stored map that can be read: no such file or folder; write the "
        "folder of a stored map that a session can begin in, or take this line out"
    )
    tiles = [TileUpdate(0, 0, 0, 1, 0.05, np.zeros((64, 64), np.int8))]
    save_map(office, tiles, 1)
    (fault,) = faults_here(config_of(FRONT, office), "v.yaml")
    assert "mapping cannot go on in it" in fault
    save_map(office, tiles, 2, graph=graph_of(4))
    assert faults_here(config_of(FRONT, office), "v.yaml") == []
