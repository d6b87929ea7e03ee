import contextlib
import math
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, LaserScan
from service import demo
from service.demo import (
    WEB_PORT,
    DemoOptions,
    Simulators,
    _page,
    _void,
    demo_config,
    interpolate,
    last_map,
    pose_error,
)
from service.encoding import Message, encode_event, encode_frame, encode_pose
from service.errors import ConfigError, CorridorError, StorageError
from service.geometry.se2 import SE2
from service.outputs import NO_REASON, MapperOutput
from service.recording.mcap_recorder import McapRecorder
from service.runtime.metrics import Percentiles
from service.runtime.summary import Summary

RANGES_M = np.array([1.0, 2.0, 3.0], np.float32)
OFFSET_NS = 1_700_000_000_000_000_000
ENDPOINTS = [
    {"name": "front", "device": "sick_lms100", "endpoint": "tcp://127.0.0.1:2111"},
    {"name": "rear", "device": "hokuyo_utm30lx", "endpoint": "/dev/pts/4"},
    {"name": "lux", "device": "ibeo_lux", "endpoint": "tcp://127.0.0.1:12002"},
    {"name": "imu", "device": "xsens_mtig", "endpoint": "/dev/pts/5"},
    {"name": "base", "device": "irobot_create", "endpoint": "/dev/pts/3"},
]


def options(out: Path, profile: str | None = None) -> DemoOptions:
    return DemoOptions(seconds=1.0, world=None, profile=profile, seed=1, out=out)


def test_the_page_is_at_the_usual_port_or_at_a_free_one_and_off_where_it_is_not_wanted(tmp_path: Path):
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with contextlib.suppress(OSError):  # else someone else has it
            taken.bind(("127.0.0.1", WEB_PORT))
            taken.listen()
        page = _page(options(tmp_path))
    assert page.listen.startswith("127.0.0.1:")
    assert page.listen != f"127.0.0.1:{WEB_PORT}"
    assert page.token_file.read_text().strip() == page.token
    web = demo_config(ENDPOINTS, options(tmp_path), 7447, page).sinks["web"]
    assert (web.enabled, web.listen, web.token_file) == (True, page.listen, page.token_file)
    assert not demo_config(ENDPOINTS, options(tmp_path), 7447).sinks["web"].enabled


def test_a_taken_port_is_reported_where_it_was_asked_for(caplog: pytest.LogCaptureFixture):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(StorageError, match=f"port {port} of 127.0.0.1 is taken, perhaps"):
            demo.free_port(port, 7447, "--port")
        other_port = demo.free_port(None, port, "--port")
        assert other_port != port
        assert f"port {port} is taken; another one is used, --port chooses which" in caplog.text
    assert demo.free_port(port, 7447, "--port") == port


def test_a_profile_that_there_is_not_is_a_config_error(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"mapping\.profile"):
        demo_config(ENDPOINTS, options(tmp_path, "corridr"), 7447)


def test_truth_that_does_not_reach_is_reported():
    truth = np.array([[0.0, 0.0, 0.0, 0.0], [10.0, 1.0, 0.0, 0.0]])
    with pytest.raises(CorridorError, match="ended too early"):
        interpolate(truth, np.array([5, 11]))


SECOND_NS = 1_000_000_000


def record(folder: Path, steps: list[tuple[int, SE2] | str]) -> Summary:
    """A finished session: scans, stamped in host monotonic time, with their poses, and events.

    A pose comes 20 ms after its scan, an event 10 ms after the scan before it: so it stands between the two.
    """
    messages: list[Message] = []
    unix_ns = OFFSET_NS
    for step in steps:
        if isinstance(step, str):
            messages.append(encode_event(step, unix_ns + 10_000_000, unix_ns + 10_000_000))
            continue
        unix_ns = step[0] + OFFSET_NS
        scan = LaserScan("front", unix_ns, unix_ns, 1, 3, 0.0, 0.1, 0.01, 20.0, RANGES_M, NO_INTENSITY)
        output = MapperOutput(
            unix_ns, step[1], SE2(), (0.0, 0.0, 0.0), np.zeros((3, 3)), "ok", NO_REASON, 1.0
        )
        messages += [encode_frame(scan), encode_pose(output, unix_ns + 20_000_000)]
    recorder = McapRecorder(folder, "demo", keep_free_bytes=0)
    recorder.start()
    for message in sorted(messages, key=lambda message: message.log_ns):
        recorder.put(message)
    nothing = Percentiles(0.0, 0.0, 0.0, 0.0)
    written = {"recording": recorder.finish()}
    return Summary(1.0, len(steps), 0, {}, nothing, nothing, {}, 0.0, written, OFFSET_NS)


def test_the_error_is_that_against_the_truth_from_the_first_pose_on(tmp_path: Path):
    """The vehicle starts at (5, 5) looking up. One of two poses is 3 cm and 2 deg off."""
    truth = tmp_path / "truth.txt"
    truth.write_text("0 5.0 5.0 1.5707963\n2000000000 5.0 7.0 1.5707963\n")
    off = SE2(1.0, 0.03, math.radians(2.0))
    summary = record(tmp_path, [(0, SE2()), (1_000_000_000, off)])
    assert pose_error(last_map(summary), truth) == {
        "position_rmse_m": pytest.approx(0.03 / math.sqrt(2), abs=1e-4),
        "heading_rmse_deg": pytest.approx(2.0 / math.sqrt(2), abs=1e-3),
    }


TRUTH = "0 0.0 0.0 0.0\n4000000000 4.0 0.0 0.0\n"
RESET, PAUSE = '{"event": "reset_map"}', '{"event": "pause"}'
SWITCH = '{"event": "switch_profile", "profile": "imle"}'
LOAD = '{"event": "load_map", "map": "office", "version": 1}'


def test_the_error_is_that_of_the_map_since_the_last_reset(tmp_path: Path):
    """Each map begins at (0, 0, 0); the last pose of the one before is reported behind the command."""
    (tmp_path / "truth.txt").write_text(TRUTH)
    off = SE2(1.0, 0.03, 0.0)
    poses = [(0, SE2()), (SECOND_NS, SE2(9.0)), (2 * SECOND_NS, SE2()), (3 * SECOND_NS, off)]
    for number, verb in enumerate((RESET, SWITCH)):
        summary = record(tmp_path / str(number), [*poses[:2], verb, *poses[2:], PAUSE])
        error = pose_error(last_map(summary), tmp_path / "truth.txt")
        assert error == {
            "position_rmse_m": pytest.approx(0.03 / math.sqrt(2), abs=1e-4),
            "heading_rmse_deg": 0.0,
        }
        assert _void({}, last_map(summary).began) is None


def test_in_a_stored_map_the_error_is_void(tmp_path: Path):
    summary = record(tmp_path, [(0, SE2()), LOAD, (SECOND_NS, SE2(7.0, 8.0, 1.0))])
    mapped = last_map(summary)
    assert pose_error(mapped, tmp_path / "truth.txt") == {"position_rmse_m": None, "heading_rmse_deg": None}
    assert _void({}, mapped.began) == (
        "a stored map was loaded, whose place in the world is not known; the error is void"
    )
    assert "no processor to send 3 of front; latency and error are void; a stored" in str(
        _void({"front": 3}, mapped.began)
    )


@pytest.mark.parametrize(
    ("code", "error", "words"),
    [
        (1, CorridorError, "the simulators ended before they were ready"),
        (ConfigError.exit_code, ConfigError, "refused the file of faults"),
    ],
)
def test_simulators_that_do_not_come_up_are_reported(
    code: int, error: type[CorridorError], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """What they end with: tests/simulators/test_run.py."""
    (ends := tmp_path / "python").write_text(f"#!/bin/sh\nexit {code}\n")
    ends.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(ends))
    wrong = DemoOptions(1.0, None, None, 1, tmp_path, tmp_path / "faults.yaml")
    with pytest.raises(error, match=words), demo.simulators(wrong, tmp_path / "truth.txt"):
        pass


def test_simulators_that_end_early_end_the_demo():
    with subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"]) as process:
        process.wait(10.0)
        assert Simulators(process, []).fault() == "the simulators ended with exit code 3"


def test_figures_of_a_demo_whose_devices_had_no_processor_are_called_void():
    words = b'{"ready": true}\n{"left_out": {"front": 12, "rear": 3}}\n'
    assert _void(demo.left_out_of(words), "") == (
        "the fake devices had no processor to send 12 of front, 3 of rear; latency and error are void"
    )
    assert _void(demo.left_out_of(b'{"left_out": {}}\n'), "") is None


def test_a_folder_that_cannot_be_written_ends_it_before_anything_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def begin(*_: object) -> None:
        raise AssertionError("begun")

    monkeypatch.setattr(demo, "free_port", begin)
    (tmp_path / "file").touch()
    for out in (tmp_path / "file" / "x", tmp_path / "file", Path("/proc/1")):  # no file can be made there
        with pytest.raises(StorageError, match=f"cannot write to {out}"):
            demo.demo(options(out))
