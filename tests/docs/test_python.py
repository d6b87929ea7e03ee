"""Python blocks are executed as they stand; those that talk, on loopback."""

import subprocess
import sys
from pathlib import Path

import numpy as np

from service.encoding import encode_pose
from service.geometry.se2 import SE2
from service.outputs import NO_REASON, MapperOutput
from tests.docs.blocks import ROOT, written_in
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

ELSEWHERE = {  # pages whose programs have a test of their own
    "docs/api.md": "tests/docs/test_api.py",
    "docs/commands.md": "tests/service/publishing/test_commands_doc.py",
    "docs/security.md": "tests/service/publishing/test_security.py",
}
HERE = {"README.md"}


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
        try:
            wait_for_subscriber(poses)
            for _ in range(3):
                poses.put(payload)
                assert reader.stdout.readline() == "x 1.00 m, y 2.00 m, heading 28.6 deg\n"
            assert reader.poll() is None
        finally:
            reader.kill()
