import json
import socketserver
from pathlib import Path

import pytest

from service.cli import main
from service.config import load_config
from service.errors import ConfigError, CorridorError, StorageError, UsageError
from service.offline.setup.discovery import Found, Wire
from service.offline.setup.new_config import render, write_new_config
from simulators.irobot_create import FakeCreate
from simulators.sick_lms100 import FakeLms100
from simulators.wire import PtyWire, TcpWire
from tests.drivers.irobot_bench import STANDING
from tests.drivers.lms100 import Room
from tests.in_background import started
from tests.system.machine import free_port

ASK_S = 60.0  # a fake device on a busy machine; the first answer ends it


class WebServer(socketserver.BaseRequestHandler):
    def handle(self) -> None:
        self.request.recv(1024)
        self.request.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")


def test_what_answers_is_in_the_config_and_what_does_not_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "vehicle.yaml"
    with (
        TcpWire(FakeLms100(Room())) as (_, port),
        PtyWire(FakeCreate(STANDING)) as device,
        socketserver.ThreadingTCPServer(("127.0.0.1", 0), WebServer) as web,
    ):
        serving, page = started(web.serve_forever), web.server_address[1]
        wires = [f"127.0.0.1:{port}", device, f"sick_lms100=127.0.0.1:{page}"]
        arguments = ["init", *wires, "--out", str(out), "--data", str(tmp_path / "data"), "--json"]
        try:
            assert main([*arguments, "--seconds", str(ASK_S)]) == 0
        finally:
            web.shutdown()
            serving.result()
    facts = json.loads(capsys.readouterr().out)
    assert facts["sensors"]["lms"]["wire"] == wires[0]
    assert facts["sensors"]["lms"]["identity"]["serial"] == "18090362"
    assert list(facts["silent"]) == [f"127.0.0.1:{page}"]
    config = load_config(out)
    assert (config.sensors["lms"].type, config.sensors["lms"].port) == ("sick_lms100", port)
    assert (config.sensors["base"].type, config.sensors["base"].device) == ("irobot_create", device)
    assert config.sinks["map"].directory == tmp_path / "data" / "maps"
    assert "# MEASURE: base frame" in config.text
    assert "serial 18090362" in config.text
    assert main(["check", str(out)]) == 0


def test_where_nothing_answers_nothing_is_written(tmp_path: Path):
    wires = [Wire(host="127.0.0.1", port=free_port()), Wire(device=str(tmp_path / "tty"))]
    with pytest.raises(CorridorError, match=r"no device answers(.|\n)*127\.0\.0\.1:(.|\n)*tty: "):
        write_new_config(wires, tmp_path / "v.yaml", ask_s=1.0)
    assert not (tmp_path / "v.yaml").exists()


def test_a_file_that_is_there_is_kept(tmp_path: Path):
    (tmp_path / "v.yaml").write_text("mine")
    with pytest.raises(UsageError, match="is there already; take it away, or name another"):
        write_new_config([Wire(host="127.0.0.1")], tmp_path / "v.yaml")
    assert (tmp_path / "v.yaml").read_text() == "mine"


def test_without_a_port_and_without_a_host_it_says_what_to_write(tmp_path: Path):
    with pytest.raises(UsageError, match=r"corridor init 192\.168\.0\.1"):
        write_new_config([], tmp_path / "v.yaml")


def test_what_a_device_says_of_itself_cannot_become_part_of_the_config(tmp_path: Path):
    found = Found(
        Wire(host="10.0.0.1"), "sick_lms100", {"host": "10.0.0.1"}, {"device": "LMS\nvehicle: evil\x07"}
    )
    text = render({"lms": found}, "veh1", tmp_path, tmp_path / "v.yaml")
    assert "\nvehicle: evil" not in text
    assert "# device LMS vehicle: evil\n" in text


def test_a_name_that_cannot_be_a_vehicle_s_is_a_config_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """And no device is asked for it, nor for a file that cannot be written."""
    requested: list[Wire] = []
    monkeypatch.setattr(
        "service.offline.setup.new_config.discover", lambda wires, ask_s: requested.extend(wires) or []
    )
    wires = [Wire(host="10.0.0.1")]
    with pytest.raises(ConfigError, match="Veh 1"):
        write_new_config(wires, tmp_path / "v.yaml", vehicle="Veh 1")
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="cannot be written"):
        write_new_config(wires, tmp_path / "file" / "v.yaml")
    assert requested == []
    assert not (tmp_path / "v.yaml").exists()
