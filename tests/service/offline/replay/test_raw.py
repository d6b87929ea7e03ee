"""Sessions recorded with their wires, mapped by what today's drivers make of the bytes."""

import heapq
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.frames import LaserScan
from service.cli import main
from service.config import parse_config
from service.encoding import LogClock, encode_event, encode_frame, encode_pose, encode_raw
from service.errors import ConfigError, InputError
from service.geometry.se2 import SE2
from service.offline.replay.raw import FROM_RAW, remake_frames
from service.offline.replay.replay import ReplayOptions, replay
from service.recording.mcap_recorder import McapRecorder
from service.recording.mcap_source import open_session
from service.sensor_kinds import SENSOR_KINDS
from simulators.device import FakeDevice
from simulators.irobot_create import FakeCreate
from simulators.sick_lms100 import FakeLms100
from simulators.truth import CREATE_WHEELS, LMS100, LaserTruth, Ride, WheelTruth
from simulators.worlds import build_world
from tests.drivers.faulty_devices import ZERO_NS, faulty
from tests.drivers.virtual_link import VirtualLink

OFFSET_NS = 1_700_000_000_000_000_000
CONFIG = """\
vehicle: v
sensors:
  front: {type: sick_lms100, host: a, mounting: {x_m: 0.2}}
  base: {type: irobot_create, device: /dev/base}
recording: {directory: s, raw: true}
map: {directory: m}
"""
METADATA = {"config": {"yaml": CONFIG}, "clock": {"utc_offset_ns": str(OFFSET_NS)}}
DRIVE_S = 6.0


@pytest.fixture(scope="module")
def links() -> dict[str, VirtualLink]:
    """A laser whose line is bad for a while, and wheels, driven through a ring of corridors."""
    ride = Ride(build_world("ring"), ZERO_NS, stand_s=1.0)
    laser = FakeLms100(LaserTruth(ride, "front", SE2(0.2, 0.0, 0.0), LMS100, 1))
    base = FakeCreate(WheelTruth(ride, "base", CREATE_WHEELS, 1), "create2", wakes_on_connect=True)
    sensors = parse_config(CONFIG, "config").sensors

    def link_of(name: str, device: FakeDevice, *faults: str) -> VirtualLink:
        sensor = sensors[name]
        link = VirtualLink(SENSOR_KINDS[sensor.type].session_maker(sensor), faulty(device, *faults), ZERO_NS)
        link.run(DRIVE_S)
        return link

    return {
        "front": link_of("front", laser, "kind: garbage, at_s: 3, for_s: 1, share: 0.2"),
        "base": link_of("base", base, "kind: half_messages, at_s: 4, for_s: 0.5, share: 0.2"),
    }


def record(
    folder: Path,
    links: dict[str, VirtualLink],
    metadata: dict[str, dict[str, str]] = METADATA,
    raw: bool = True,
    events: tuple[tuple[float, str], ...] = (),
    first_chunk: int = 0,
) -> Path:
    """As the service records: bytes at their own times, frames at rising ones. events: at s, name."""
    frames = heapq.merge(*(link.passed_on for link in links.values()), key=lambda frame: frame.arrived_ns)
    clock = LogClock()
    messages = [
        encode_frame(frame, OFFSET_NS, clock.next_ns(frame.arrived_ns + OFFSET_NS)) for frame in frames
    ]
    for name, link in links.items():
        messages += [encode_raw(name, chunk, OFFSET_NS) for chunk in link.chunks[first_chunk:] if raw]
    for at_s, event in events:
        log_ns = ZERO_NS + OFFSET_NS + round(at_s * 1e9) + 1
        messages.append(encode_event(json.dumps({"event": event}), log_ns, log_ns))
    recorder = McapRecorder(folder, "v", keep_free_bytes=0, metadata=metadata)
    recorder.start()
    for message in sorted(messages, key=lambda message: message.log_ns):
        recorder.put(message)
    (session,) = recorder.finish()
    return session


def test_what_is_mapped_is_what_was_mapped_without_the_recorded_frames(
    links: dict[str, VirtualLink], tmp_path: Path
):
    """As where a driver could make nothing of the bytes then."""
    mute = {name: VirtualLink(lambda: None, link.device, 0) for name, link in links.items()}
    for name, link in links.items():
        mute[name].chunks = link.chunks
    paused = ((3.0, "pause"), (3.5, "resume"))
    raw = record(tmp_path / "mute", mute, events=paused)
    with pytest.raises(InputError, match="LaserScan"):
        open_session([raw])
    recorded = replay([record(tmp_path, links, events=paused)], ReplayOptions())
    again = replay([raw], ReplayOptions(from_raw=True))
    assert [encode_pose(output, 0).payload for output in again.outputs] == [
        encode_pose(output, 0).payload for output in recorded.outputs
    ]
    assert len(again.outputs) > 100
    assert again.summary["scans_paused"] == recorded.summary["scans_paused"] > 20
    assert again.summary[FROM_RAW]["front"]["frames"] > 200
    assert FROM_RAW not in recorded.summary


def test_another_config_sets_the_drivers_otherwise(links: dict[str, VirtualLink], tmp_path: Path):
    session, remade, config = record(tmp_path, links), tmp_path / "remade.mcap", tmp_path / "later.yaml"
    config.write_text(CONFIG.replace("host: a", "host: a, latency_ms: 5"))
    remake_frames([session], config, remade)
    before, after = (
        [frame.stamp_ns for frame in open_session([path]).frames() if isinstance(frame, LaserScan)]
        for path in (session, remade)
    )
    np.testing.assert_array_equal(np.array(before) - after, 5_000_000)
    config.write_text("vehicle: [")
    with pytest.raises(ConfigError):
        remake_frames([session], config, tmp_path / "none.mcap")


def test_a_sensor_without_raw_bytes_is_left_out_and_named(
    links: dict[str, VirtualLink], tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    session = record(tmp_path, {"front": links["front"]})
    assert list(remake_frames([session], None, tmp_path / "remade.mcap")) == ["front"]
    assert "no /base/raw, so base is left out" in caplog.text


@pytest.mark.parametrize(
    ("lacks", "words"),
    [
        ({"raw": False}, r"no raw bytes to run .* recording: \{raw: true\}"),
        ({"first_chunk": 1}, r"front and base were recorded in mid-stream; give all files"),
        ({"metadata": {"clock": METADATA["clock"]}}, "holds no config of its sensors; give one by --config"),
    ],
    ids=["raw bytes", "the first bytes", "the config"],
)
def test_a_recording_that_lacks_something_is_refused_in_words(
    links: dict[str, VirtualLink],
    tmp_path: Path,
    lacks: dict[str, Any],
    words: str,
    capsys: pytest.CaptureFixture[str],
):
    assert main(["replay", str(record(tmp_path, links, **lacks)), "--from-raw"]) == InputError.exit_code
    printed = capsys.readouterr().err
    assert re.search(words, printed), printed
    assert "Traceback" not in printed
