"""Python blocks are executed as they stand; those that talk, on loopback."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drivers.link import RawChunk
from drivers.sick_lms100.driver import Lms100Session
from service.encoding import encode_pose, encode_raw
from service.geometry.se2 import SE2
from service.outputs import NO_REASON, MapperOutput
from service.recording.mcap_file import McapFile
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from tests.docs.blocks import ROOT, written_in
from tests.drivers.lms100 import Room, config
from tests.drivers.virtual_time import Talk
from tests.service.publishing.conftest import (
    client,
    open_client,
    open_publisher,
    open_session,
    publisher,
    store,
    wait_for_subscriber,
)

__all__ = ["client", "open_client", "open_publisher", "open_session", "publisher", "store"]  # fixtures

RECIPES = ("own_laser", "live_plot", "batch", "map_elsewhere")
ELSEWHERE = {  # pages whose programs have a test of their own
    "docs/api.md": "tests/docs/test_api.py",
    **{f"docs/recipes/{name}.md": "tests/docs/test_api.py" for name in RECIPES},
    "docs/commands.md": "tests/service/publishing/test_commands_doc.py",
    "docs/security.md": "tests/service/publishing/test_security.py",
    "docs/subscribing.md": "tests/service/publishing/test_subscribing_doc.py",
}
HERE = {"README.md", "docs/recording.md"}


def program_of(page):
    (block,) = [block for block in written_in("python") if block.page == page]
    return block.text


def test_no_program_is_without_a_test():
    assert {block.page for block in written_in("python")} == HERE | ELSEWHERE.keys()
    for page, test in ELSEWHERE.items():
        assert Path(page).name in (ROOT / test).read_text()


def test_the_subscriber_prints_poses_for_as_long_as_they_come(publisher, client, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "service" / "python"))
    output = MapperOutput(1, SE2(1.0, 2.0, 0.5), SE2(), (0.0, 0.0, 0.0), np.eye(3), "ok", NO_REASON, 1.0)
    payload = encode_pose(output, 1).payload
    here = program_of("README.md").replace("tcp/127.0.0.1:7447", publisher.endpoints[0])
    poses = client.declare_publisher("corridor/v1/veh1/pose")
    with subprocess.Popen([sys.executable, "-u", "-c", here], stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        try:
            wait_for_subscriber(poses)
            for _ in range(3):
                poses.put(payload)
                assert reader.stdout.readline() == "x 1.00 m, y 2.00 m, heading 28.6 deg\n"
            assert reader.poll() is None
        finally:
            reader.kill()


class Taped:
    """A session that keeps what its wire said."""

    def __init__(self, session: Lms100Session) -> None:
        self.session = session
        self.chunks: list[RawChunk] = []

    def __getattr__(self, name: str) -> object:
        return getattr(self.session, name)

    def receive_data(self, data: bytes, arrived_ns: int) -> object:
        self.chunks.append(RawChunk(arrived_ns, "received", data))
        return self.session.receive_data(data, arrived_ns)

    def tick(self, now_ns: int) -> None:
        self.chunks.append(RawChunk(now_ns, "sent", b""))
        self.session.tick(now_ns)


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    """The wire of a LMS100 in a file of the name that docs/recording.md uses; the frames of then."""
    monkeypatch.chdir(tmp_path)
    taped = Taped(Lms100Session(config()))
    talk = Talk(taped, FakeLms100(Room(), Lms100Setup()))  # type: ignore[arg-type]
    taped.chunks.append(RawChunk(talk.now_ns, "connected"))
    talk.connect().run(3.0)
    path = tmp_path / "veh1_20261121T101500Z_0001.mcap"
    file = McapFile(path, talk.now_ns)
    text = "vehicle: veh1\nsensors: {front: {type: sick_lms100, host: 127.0.0.1}}\n"
    file.write_metadata("config", {"yaml": f"{text}recording: {{directory: s}}\nmap: {{directory: m}}\n"})
    file.write_metadata("clock", {"utc_offset_ns": "1700000000000000000"})
    for chunk in taped.chunks:
        file.write(encode_raw("front", chunk, 1_700_000_000_000_000_000))
    file.finish()
    return talk.frames


def test_a_recorded_wire_makes_the_frames_of_then(recorded):
    names: dict[str, object] = {}
    exec(compile(program_of("docs/recording.md"), "docs/recording.md", "exec"), names)
    frames = names["frames"]
    assert isinstance(frames, list)
    assert len(frames) > 50
    assert len(frames) >= len(recorded) - 2  # those from before the clock is known are held back
    for frame, then in zip(frames, recorded[-len(frames) :], strict=True):
        assert frame.stamp_ns == then.stamp_ns
        np.testing.assert_array_equal(frame.range_m, then.range_m)
