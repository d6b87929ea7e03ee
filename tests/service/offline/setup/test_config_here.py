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
