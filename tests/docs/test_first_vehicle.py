"""docs/first_vehicle.md from the config to the map, command by command, on fake devices."""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import yaml

from service.cli import main
from service.mapstore.ros_map import read_ros_map
from service.outputs import FREE, OCCUPIED
from tests.docs.blocks import ROOT, written_in
from tests.docs.test_shell import commands_of
from tests.system.machine import START_TIMEOUT_S, STOP_TIMEOUT_S, FakeVehicle, Subscriber, free_port

PAGE = "docs/first_vehicle.md"
SCANS = 60  # more than a second
COMMANDS = [
    words[1:]
    for block in written_in("sh")
    if block.page == PAGE
    for words in commands_of(block.text)
    if words[0] == "corridor"
]
WRITTEN = next(yaml.safe_load(block.text) for block in written_in("yaml") if block.page == PAGE)  # by init
ELSEWHERE = ("demo", "calibrate")  # need half a minute and more; tests of their own


@pytest.fixture
def vehicle(tmp_path, monkeypatch) -> Iterator[FakeVehicle]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))  # these sources, not those installed
    monkeypatch.chdir(tmp_path)
    fake = FakeVehicle(tmp_path, stand_s=1.0)
    fake.start()
    yield fake
    fake.stop()


def drive(config: Path) -> None:
    """`corridor run`, as the page says: until Ctrl-C, which is SIGINT."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    settings = yaml.safe_load(config.read_text())
    settings["publishing"] = {"listen": [endpoint]}
    settings["web"] = {"enabled": False}
    settings["recording"]["keep_free_gb"] = 0.1
    config.write_text(yaml.safe_dump(settings))
    command = [sys.executable, "-m", "service", "run", str(config)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as service:
        try:
            output = []
            for line in service.stderr:
                output.append(line)
                if "ready" in line:
                    break
            assert service.poll() is None, "".join(output)
            with closing(Subscriber(endpoint)) as subscriber:
                subscriber.wait_for("pose", SCANS, START_TIMEOUT_S)
            service.send_signal(2)
            service.communicate(timeout=STOP_TIMEOUT_S)
            assert service.returncode == 0
        finally:
            service.kill()


def test_the_page_leads_from_the_wires_to_a_map_for_nav2(vehicle, tmp_path, capsys):
    names = [words[0] for words in COMMANDS]
    assert names == ["demo", "init", "check", "doctor", "run", "calibrate", "check", "replay", "export"]
    for words in COMMANDS:
        if words[0] in ELSEWHERE or "calibrated.yaml" in words[1]:
            continue
        if words[0] == "run":
            drive(tmp_path / words[1])
            continue
        here = {
            "192.168.0.1": f"sick_lms100=127.0.0.1:{vehicle.port}",
            "/dev/ttyUSB0": f"irobot_create={vehicle.terminal}",
            "sessions/veh1_20261121T101500Z_0001.mcap": str(next(iter(tmp_path.glob("sessions/*.mcap")), "")),
            "calibrated.yaml": "vehicle.yaml",
        }
        command = [here.get(word, word) for word in words]
        code = main(command)
        output = capsys.readouterr()
        if words[0] == "doctor":  # on a busy machine it finds fault, with the rates of the devices, too
            streaming = [line.split()[:2] for line in output.out.splitlines() if " streams: " in line]
            assert streaming == [["ok", "front"], ["ok", "base"]]
        else:
            assert code == 0, f"{command}: {output.out}{output.err}"
        if words[0] == "init":
            assert "Rename the laser to where it sits, `front`" in (ROOT / PAGE).read_text()
            config = tmp_path / "vehicle.yaml"
            config.write_text(config.read_text().replace("\n  lms:", "\n  front:"))
            sensors = yaml.safe_load(config.read_text())["sensors"]
            assert {name: sensor["type"] for name, sensor in sensors.items()} == {
                name: sensor["type"] for name, sensor in WRITTEN["sensors"].items()
            }
    summary = json.loads((tmp_path / "result" / "summary.json").read_text())
    assert summary["scans"] >= SCANS
    cells = read_ros_map(tmp_path / "hall.yaml").cells
    assert (cells == OCCUPIED).sum() > 100
    assert (cells == FREE).sum() > 1000
