import json
from pathlib import Path

import pytest

from service.cli import main
from service.offline.doctor.devices import Patience
from service.offline.doctor.examine import examine
from simulators.irobot_create import FakeCreate
from simulators.sick_lms100 import FakeLms100
from simulators.wire import PtyWire, TcpWire
from tests.drivers.irobot_bench import STANDING
from tests.drivers.lms100 import Room

CONFIG = """\
vehicle: veh1
sensors:
  front: {{type: sick_lms100, host: 127.0.0.1, port: {port}}}
  base: {{type: irobot_create, device: {device}}}
publishing: {{listen: ["tcp/127.0.0.1:0"]}}
web: {{listen: "127.0.0.1:0"}}
recording: {{directory: {folder}/sessions, keep_free_gb: 0, rotate_mb: 1}}
map: {{directory: {folder}/maps}}
"""


def written(tmp_path: Path, port: int, device: str) -> Path:
    path = tmp_path / "veh1.yaml"
    path.write_text(CONFIG.format(port=port, device=device, folder=tmp_path))
    return path


@pytest.mark.usefixtures("any_rate_will_do")
def test_a_vehicle_in_order_exits_with_0(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with TcpWire(FakeLms100(Room())) as (_, port), PtyWire(FakeCreate(STANDING)) as device:
        config = written(tmp_path, port, device)
        assert main(["doctor", str(config), "--json", "--seconds", "0.5"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["ok"] is True
    streaming = {f["who"]: f["values"]["rate_hz"] for f in facts["findings"] if "rate_hz" in f["values"]}
    assert streaming.keys() == {"front", "base"}
    assert {f["who"] for f in facts["findings"]} >= {"config", "zenoh", "recording", "map", "disk"}
    assert {f["who"] for f in facts["findings"]} >= {"clock", "cache", "rights", "unit"}


def test_a_vehicle_with_a_fault_exits_with_1_and_says_what_to_do(
    tmp_path: Path, closed_port: int, capsys: pytest.CaptureFixture[str]
):
    config = written(tmp_path, closed_port, "/dev/corridor/nothing")
    assert main(["doctor", str(config)]) == 1
    printed = capsys.readouterr().out
    assert f"nothing listens at port {closed_port}" in printed
    assert "/dev/corridor/nothing is not there" in printed
    assert "to do: " in printed
    assert printed.endswith("2 faults\n")
    assert "\x1b" not in printed


@pytest.mark.parametrize("text", ["vehicle: veh1\nsensors: {front: {type: sick_lms1000}}\n", "a: [", ""])
def test_a_bad_config_exits_with_78_and_the_machine_is_looked_at_all_the_same(
    tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]
):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    assert main(["doctor", str(path), "--json"]) == 78
    facts = json.loads(capsys.readouterr().out)
    assert facts["findings"][0]["severity"] == "fault"
    assert str(path) in facts["findings"][0]["measured"]
    assert facts["findings"][-1]["who"] == "unit"


def test_without_a_config_the_machine_alone_is_looked_at():
    report, exit_code = examine(None, patience=Patience())
    assert {finding.who for finding in report.findings} == {"clock", "cache", "rights", "unit"}
    assert exit_code == report.exit_code
