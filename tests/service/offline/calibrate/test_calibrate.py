"""The command: a recorded drive in, mountings, scales and offsets out, as a config that `check` takes."""

import hashlib
import json
import math
from dataclasses import replace
from typing import ClassVar

import pytest
import yaml

from service.cli import main
from service.config import load_config
from service.errors import ConfigError, InputError, UsageError
from service.geometry.se2 import SE2
from service.offline.calibrate import calibrate
from service.offline.calibrate.tracks import LaserMapping
from service.offline.importing.session_file import write_session
from simulators.truth import LMS100, UTM30LX, Ride
from tests.service.offline.calibrate.drives import Vehicle, frames_of, one_laser, to_both_sides
from tests.service.recording.bags import write_ros1
from tests.service.recording.sessions import drive
from tests.simulated import Wheels

FRONT = SE2(0.24, -0.05, math.radians(3.0))
REAR = SE2(-0.18, 0.02, math.radians(178.0))
LATE_S = {"base": 0.012, "rear": -0.007}
SCALE, TURN_SCALE = 0.97, 1.03  # of what the wheels count
CONFIG = """\
vehicle: veh1
# the wires stay as they are
sensors:
  front: {type: sick_lms100, host: a, latency_ms: 1.0, mounting: {x_m: 0.2, y_m: 0.0, z_m: 0.3, yaw_deg: 0.0}}
  rear: {type: hokuyo_utm30lx, host: 10.0.0.2, mounting: {x_m: -0.2, yaw_deg: 180.0}}   # looks back
  base: {type: irobot_create, device: /dev/corridor/create, wheel_base_m: 0.24, left_scale: 1.01}
recording: {directory: sessions}
map: {directory: maps}
"""


@pytest.fixture(scope="module")
def frames():
    vehicle = Vehicle(
        lasers=(one_laser(FRONT, LMS100, beams=181), one_laser(REAR, UTM30LX, "rear", beams=181)),
        wheels=Wheels(SCALE, TURN_SCALE),
        late_s=tuple(LATE_S.items()),
    )
    return frames_of(Ride(to_both_sides(), 0, 1.0), vehicle, 36.0, 1)


@pytest.fixture(scope="module")
def session(frames, tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    write_session(path, frames, {}, {}, log_times=True)
    return path


class RememberedMapping:
    """Maps with the scans of a laser, each once: config and wheels change no path of a laser."""

    known: ClassVar = {}  # digest of the scans -> track

    def __init__(self, sensor):
        self._sensor, self._scans, self._digest = sensor, [], hashlib.sha256(sensor.encode())

    def add(self, scan):
        self._scans.append(scan)
        self._digest.update(f"{scan.stamp_ns} {scan.arrived_ns} ".encode() + scan.range_m.tobytes())

    def finish(self):
        scans = self._digest.digest()
        if scans not in self.known:
            mapping = LaserMapping(self._sensor)
            for scan in self._scans:
                mapping.add(scan)
            self.known[scans] = mapping.finish()
        return self.known[scans]


@pytest.fixture(autouse=True)
def mapped_once(monkeypatch):
    monkeypatch.setattr(calibrate, "LaserMapping", RememberedMapping)


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "vehicle.yaml"
    path.write_text(CONFIG)
    return path


def test_a_wrong_config_is_mended(session, config, tmp_path, capsys):
    mended = tmp_path / "calibrated.yaml"
    command = ["calibrate", str(session), "--config", str(config), "--out", str(mended), "--json"]
    assert main(command) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["reference"] == "front"
    assert main(["check", str(mended)]) == 0
    sensors = load_config(mended).sensors
    for name, true in (("front", FRONT), ("rear", REAR)):
        mounting = sensors[name].mounting
        assert mounting.x_m == pytest.approx(true.x_m, abs=0.01)
        assert mounting.y_m == pytest.approx(true.y_m, abs=0.01)
        off_deg = math.remainder(mounting.yaw_deg - math.degrees(true.theta_rad), 360.0)
        assert off_deg == pytest.approx(0.0, abs=0.15)
    assert sensors["front"].mounting.z_m == 0.3
    assert sensors["front"].latency_ms == 1.0  # the others are counted against its clock
    assert sensors["rear"].latency_ms == pytest.approx(-7.0, abs=1.5)
    base = sensors["base"]
    assert base.latency_ms == pytest.approx(12.0, abs=2.5)
    assert (base.left_scale / 1.01 + base.right_scale) / 2.0 == pytest.approx(1.0 / SCALE, rel=0.004)
    turn_scale = (base.left_scale / 1.01 + base.right_scale) / 2.0 * 0.24 / base.wheel_base_m
    assert turn_scale == pytest.approx(1.0 / TURN_SCALE, rel=0.004)
    text = mended.read_text()
    assert "# the wires stay as they are" in text
    assert "# looks back" in text


def test_turns_to_the_other_side_change_nothing_and_are_reported(frames, config, tmp_path, capsys):
    """Whether the laser or the wheels are mirrored, the drive does not tell."""
    mirrored = [_mirrored(frame) if frame.sensor == "base" else frame for frame in frames]
    path = tmp_path / "mirrored.mcap"
    write_session(path, mirrored, {}, {}, log_times=True)
    assert main(["calibrate", str(path), "--config", str(config), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    by_name = {one["sensor"]: one for one in facts["sensors"]}
    (note,) = by_name["base"]["notes"]
    assert "base counts turns to the other side than front sees them" in note
    assert "is front upside down (mounting: upside_down)" in note
    changed = yaml.safe_load(facts["patch"])["sensors"]
    assert changed["base"].keys() == {"latency_ms"}
    assert "front" not in changed
    assert by_name["front"]["values"] == []


def _mirrored(sample):
    forward, left, turn = sample.twist_mps_radps
    return replace(
        sample, y_m=-sample.y_m, theta_rad=-sample.theta_rad, twist_mps_radps=(forward, -left, -turn)
    )


def test_what_the_config_refuses_is_left_out_and_reported(session, config, capsys):
    refused = {
        "base": "base: {type: irobot_create, device: /dev/b, wheel_base_m: 0.24, left_scale: 2.0}",
        "front": "front: {type: irobot_create, device: /dev/c}",
    }
    lines = [
        next((f"  {new}" for name, new in refused.items() if one.strip().startswith(f"{name}:")), one)
        for one in CONFIG.splitlines()
    ]
    config.write_text("\n".join(lines))
    assert main(["calibrate", str(session), "--config", str(config), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert not set(refused) & set(yaml.safe_load(report["patch"])["sensors"])
    notes = {one["sensor"]: one["notes"] for one in report["sensors"]}
    (of_base,), (of_front,) = notes["base"], notes["front"]
    assert "the config's base (irobot_create) does not take it: left_scale 2.0" in of_base
    assert "the config's front (irobot_create) does not take it: unknown key mounting" in of_front


def test_a_recorded_config_that_cannot_be_read_is_refused_unless_another_is_given(
    record_drive, config, capsys
):
    drive = str(record_drive(config="sensors: {}"))
    assert main(["calibrate", drive]) == ConfigError.exit_code
    assert ".mcap, recorded config:1:" in capsys.readouterr().err
    assert main(["calibrate", drive, "--config", str(config)]) != ConfigError.exit_code


def test_without_a_config_there_is_a_patch_of_what_the_recording_names(session, capsys):
    assert main(["calibrate", str(session), "--reference", "rear"]) == 0
    printed = capsys.readouterr().out
    assert "times are against rear" in printed
    patch = yaml.safe_load(printed[printed.index("sensors:") :])
    assert patch["sensors"]["front"]["mounting"]["x_m"] == pytest.approx(FRONT.x_m, abs=0.01)
    assert patch["sensors"]["front"]["latency_ms"] == pytest.approx(7.0, abs=1.5)
    assert "wheel_base_m" not in patch["sensors"]["base"]  # it was not given


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--reference", "base"], "--reference base: no laser of this recording; it has front and rear"),
        (["{folder}/other.mcap"], "are 2 drives; calibrate by one"),
        (["--out", "{session}"], "would be overwritten"),
    ],
)
def test_wrong_usage_is_refused_and_the_session_stays(session, tmp_path, capsys, options, words):
    before = session.read_bytes()
    (tmp_path / "other.mcap").write_bytes(before)
    options = [option.format(folder=tmp_path, session=session) for option in options]
    assert main(["calibrate", str(session), *options]) == UsageError.exit_code
    assert words in capsys.readouterr().err
    assert session.read_bytes() == before


def test_what_could_not_be_read_of_a_recording_is_a_warning(tmp_path, capsys):
    bag = write_ros1(tmp_path / "drive.bag", drive(20))
    bag.write_bytes(bag.read_bytes()[:-1000])
    assert main(["calibrate", str(bag)]) == InputError.exit_code  # of so few scans
    assert "drive.bag was not closed, or is cut off or damaged" in capsys.readouterr().err


def test_a_laser_that_cannot_be_calibrated_is_reported_beside_the_others(frames, tmp_path, capsys):
    path = tmp_path / "short.mcap"
    rear = [frame for frame in frames if frame.sensor == "rear"]
    gone = {id(frame) for frame in rear[20:]}
    write_session(path, [frame for frame in frames if id(frame) not in gone], {}, {}, log_times=True)
    assert main(["calibrate", str(path), "--json"]) == 0
    by_name = {one["sensor"]: one for one in json.loads(capsys.readouterr().out)["sensors"]}
    assert by_name["rear"]["latency_p50_ms"] is None
    assert by_name["rear"]["notes"] == ["rear: 20 scans; expected 100 or more to calibrate by"]
    assert by_name["front"]["values"]
