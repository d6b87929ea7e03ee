import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from simulators.device import TURNS_SKIPPED
from simulators.run import main, warn_of_losses
from simulators.truth import Ride
from simulators.vehicle import FakeVehicle, parse_devices
from simulators.wire import DROPPED
from simulators.worlds import build_world

PATIENCE_S = 60.0  # kernels may have to be compiled
COMMAND = (sys.executable, "-m", "simulators")


@pytest.fixture
def simulate() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    running: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        running.append(subprocess.Popen([*COMMAND, *arguments], stdout=subprocess.PIPE, text=True))
        return running[-1]

    yield start
    for process in running:
        process.kill()
        process.wait(PATIENCE_S)
        process.stdout.close()


def endpoints(process: subprocess.Popen[str]) -> dict[str, str]:
    found = {}
    while "ready" not in (line := json.loads(process.stdout.readline())):
        found[line["name"]] = line["endpoint"]
    assert line == {"ready": True}
    return found


def test_both_devices_answer_and_the_truth_is_written(simulate, tmp_path: Path):
    truth_path = tmp_path / "truth.txt"
    process = simulate("--print-endpoints", "--truth", str(truth_path), "--stand-s", "0.2")
    where = endpoints(process)

    host, port = where["front"].removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as laser:
        laser.sendall(b"\x02sEN LMDscandata 1\x03")
        received = b""
        while received.count(b"sSN LMDscandata") < 20:
            received += laser.recv(65536)
    assert b"sEA LMDscandata" in received

    base = os.open(where["base"], os.O_RDWR | os.O_NOCTTY)
    os.write(base, bytes([128, 142, 35]))  # start, ask for the mode: passive
    assert select.select([base], [], [], PATIENCE_S)[0]
    assert os.read(base, 100) == b"\x01"
    os.close(base)

    process.send_signal(signal.SIGTERM)
    assert process.wait(PATIENCE_S) == 0
    stamps_ns = np.loadtxt(truth_path, usecols=0, dtype=np.int64)
    poses = np.loadtxt(truth_path, usecols=(1, 2, 3))
    assert (np.diff(stamps_ns) == 5_000_000).all()
    assert (poses[:40] == 0.0).all()
    assert poses[-1, 0] > 0.0
    assert 0 <= time.monotonic_ns() - stamps_ns[-1] < PATIENCE_S * 1e9


def test_it_ends_when_its_parent_dies():
    middleman = (
        "import subprocess, sys; process = subprocess.Popen([sys.executable, '-m', 'simulators', "
        "'--print-endpoints', '--die-with-parent'], stdout=subprocess.PIPE); "
        "[process.stdout.readline() for _ in range(3)]; print(process.pid, flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", middleman], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        child = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
    ended = bool(select.select([child], [], [], PATIENCE_S)[0])
    if not ended:
        signal.pidfd_send_signal(child, signal.SIGKILL)
    os.close(child)
    assert ended, "still running after its parent died"


@pytest.mark.parametrize(
    "arguments",
    [
        ["--world", "moon"],
        ["--device", "front=toaster"],
        ["--frobnicate"],
        *(["--stand-s", seconds] for seconds in ("nan", "-1", "inf", "long")),
    ],
)
def test_wrong_usage_is_64(arguments: list[str]):
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == 64


def test_a_disk_that_refuses_the_truth_is_74_and_names_the_file():
    arguments = [*COMMAND, "--truth", "/dev/full"]
    ended = subprocess.run(arguments, capture_output=True, text=True, timeout=PATIENCE_S)
    assert ended.returncode == 74
    assert ended.stderr.splitlines()[-1] == (
        "corridor: /dev/full: the truth cannot be written: No space left on device; make room, or name "
        "another file by --truth"
    )


def test_faults_come_at_their_time_and_are_summed_up(tmp_path: Path):
    faults = tmp_path / "faults.yaml"
    faults.write_text(
        "faults:\n"
        "  - {device: front, kind: cut, at_s: 0.2, for_s: 0.3}\n"
        "  - {device: base, kind: restart, at_s: 0.2, for_s: 0.3}\n"
    )
    command = [*COMMAND, "--print-endpoints", "--faults", str(faults)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            where = endpoints(process)
            host, port = where["front"].removeprefix("tcp://").split(":")
            begun = {process.stderr.readline() for _ in range(2)}
            assert begun == {"front: cut for 0.3 s\n", "base: restart for 0.3 s\n"}
            deadline_s = time.monotonic() + PATIENCE_S
            while True:
                try:
                    with socket.create_connection((host, int(port)), timeout=PATIENCE_S):
                        os.close(os.open(where["base"], os.O_RDWR | os.O_NOCTTY))
                        break
                except (ConnectionError, FileNotFoundError):  # refused, or reset by a listener that closes
                    assert time.monotonic() < deadline_s
        finally:
            process.send_signal(signal.SIGINT)
        _, facts = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert "front had 1 cut" in facts
    assert "base had 1 restart" in facts
    assert not Path(where["base"]).parent.exists()


def test_files_that_cannot_be_used_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    for module, name in ((signal, "pthread_sigmask"), (sys, "setswitchinterval")):
        monkeypatch.setattr(module, name, lambda *_: None)  # of the process that tests
    faults = tmp_path / "faults.yaml"
    faults.write_text("faults:\n  - {device: rear, kind: cut}\n")
    assert main(["--faults", str(faults)]) == 78
    assert f"corridor: {faults}:2:6: faults.0.device: there is no device 'rear'" in caplog.messages[-1]
    assert main(["--truth", str(tmp_path / "nowhere" / "truth.txt")]) == 74
    assert caplog.messages[-1] == f"corridor: {tmp_path}/nowhere/truth.txt: No such file or directory"


def test_losses_of_this_side_are_reported_once_each(caplog: pytest.LogCaptureFixture):
    vehicle = FakeVehicle(parse_devices([]), Ride(build_world("ring"), 0, 0.0), seed=1)
    facts: Counter[tuple[str, str]] = Counter()
    with caplog.at_level("WARNING"):
        warn_of_losses(vehicle, facts)
        assert caplog.messages == []
        vehicle.devices["base"].counters[TURNS_SKIPPED] += 7  # type: ignore[union-attr]
        vehicle.wires["front"].counters[DROPPED] += 2
        warn_of_losses(vehicle, facts)
        vehicle.devices["base"].counters[TURNS_SKIPPED] += 3  # type: ignore[union-attr]
        warn_of_losses(vehicle, facts)
        warn_of_losses(vehicle, facts)
    assert [message.partition(";")[0] for message in caplog.messages] == [
        "front: 2 more messages_dropped_slow_reader",
        "base: 7 more turns_skipped",
        "base: 3 more turns_skipped",
    ]
