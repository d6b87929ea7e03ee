"""Parts of end-to-end tests: fake devices, a service, a subscriber."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml
import zenoh

from drivers.zenoh_callback import daemon_callback
from drivers.zenoh_config import zenoh_config
from tests.in_background import started

START_TIMEOUT_S = 90.0  # a cold kernel cache is compiled first
STOP_TIMEOUT_S = 30.0
PATIENCE_S = 60.0  # for events that take 1 to 10 s on an idle machine
VEHICLE = "veh1"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class FakeVehicle:
    """`python -m simulators` with a laser on a fixed port and a base on a named terminal; can start again."""

    def __init__(self, folder: Path, stand_s: float = 1.0, faults: Path | None = None) -> None:
        self.truth = folder / "truth.txt"
        self.port, self.terminal = free_port(), folder / "base"
        self._stand_s, self._faults = stand_s, faults
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        command = [sys.executable, "-m", "simulators", "--print-endpoints", "--die-with-parent"]
        command += ["--truth", str(self.truth), "--stand-s", str(self._stand_s)]
        command += ["--device", f"front=sick_lms100:port={self.port}"]
        command += ["--device", f"base=irobot_create:link={self.terminal}"]
        command += ["--faults", str(self._faults)] if self._faults is not None else []
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        for line in self._process.stdout:
            if json.loads(line).get("ready"):
                return
        raise AssertionError(f"the simulators ended with {self._process.wait()}")

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait(STOP_TIMEOUT_S)
            self._process.stdout.close()
            self._process = None

    def sensors(self) -> dict[str, Any]:
        """The `sensors:` of a config for it."""
        return {
            "front": {
                "type": "sick_lms100",
                "host": "127.0.0.1",
                "port": self.port,
                "mounting": {"x_m": 0.2},
            },
            "base": {"type": "irobot_create", "device": str(self.terminal)},
        }


class Systemd:
    """The far end of NOTIFY_SOCKET. Listens all the time, as systemd does."""

    def __init__(self, folder: Path) -> None:
        self.address = str(folder / "notify")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.address)
        self._changed = threading.Condition()
        self.words: list[str] = []
        self._listening = started(self._listen)

    def _listen(self) -> None:
        while (word := self._socket.recv(4096).decode()) != "close":
            with self._changed:
                self.words.append(word)
                self._changed.notify_all()

    def wait_for(self, start: str | tuple[str, ...], timeout_s: float = PATIENCE_S, after: int = 0) -> None:
        """Until a word that begins with `start`, or one of several, came, `after` words or later."""
        with self._changed:
            heard = self._changed.wait_for(
                lambda: any(word.startswith(start) for word in self.words[after:]), timeout_s
            )
            assert heard, f"no {start} within {timeout_s} s; heard {self.words}"

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as own:
            own.sendto(b"close", self.address)
        self._listening.result(STOP_TIMEOUT_S)
        self._socket.close()


class LiveService:
    """`corridor run` in a process of its own, with a fake systemd beside it."""

    def __init__(self, folder: Path, sensors: dict[str, Any], raw: bool = False, **publishing: Any) -> None:
        self.systemd = Systemd(folder)
        self.sessions, self.maps = folder / "sessions", folder / "maps"
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.config = folder / "vehicle.yaml"
        self._log = folder / "service.log"
        self._process: subprocess.Popen[bytes] | None = None
        settings = {
            "vehicle": VEHICLE,
            "sensors": sensors,
            "publishing": {"listen": [self.endpoint], **publishing},
            "recording": {"directory": str(self.sessions), "keep_free_gb": 0.1, "raw": raw},
            "map": {"directory": str(self.maps)},
            "web": {"listen": "127.0.0.1:0", "token_file": str(folder / "web.token")},
        }
        self.config.write_text(yaml.safe_dump(settings, sort_keys=False))

    @property
    def log(self) -> str:
        return self._log.read_text()

    def start(self, watchdog_s: float = 1.0) -> None:
        """Start it and wait for READY=1."""
        environment = os.environ | {
            "NOTIFY_SOCKET": self.systemd.address,
            "WATCHDOG_USEC": str(round(watchdog_s * 1e6)),
        }
        before = len(self.systemd.words)
        command = [sys.executable, "-c", "import sys; from service.cli import main; sys.exit(main())"]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [*command, "run", str(self.config)], env=environment, stdout=log, stderr=log
            )
        try:
            self.systemd.wait_for("READY=1", START_TIMEOUT_S, before)
        except AssertionError as error:
            raise AssertionError(f"{error}; its log:\n{self.log}") from None

    @property
    def pid(self) -> int:
        """Of its own process, not that of the mapper."""
        return self._process.pid

    @property
    def libraries(self) -> str:
        """What its own process has mapped."""
        return Path(f"/proc/{self.pid}/maps").read_text()

    def signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def wait(self) -> int:
        """Its exit code."""
        return self._process.wait(STOP_TIMEOUT_S)

    def close_process(self) -> None:
        """Kill it where it runs; it can start again."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait(STOP_TIMEOUT_S)

    def close(self) -> None:
        self.close_process()
        self.systemd.close()


class Subscriber:
    """A Zenoh client that keeps the samples received, by channel, with the time of arrival.

    settings    further ones of its session, by path
    """

    def __init__(self, endpoint: str, settings: Mapping[str, Any] = MappingProxyType({})) -> None:
        its = {"mode": "client", "connect/endpoints": [endpoint], "connect/timeout_ms": 20_000}
        self.session = zenoh.open(zenoh_config(its | settings))
        self._changed = threading.Condition()
        self.heard: dict[str, list[tuple[float, bytes]]] = {}
        self.versions: dict[str, int] = {}  # of tiles, by channel
        self._root = f"corridor/v1/{VEHICLE}/"
        hear = daemon_callback(self._hear, "subscriber")
        self._subscriber = self.session.declare_subscriber(self._root + "**", hear)

    def _hear(self, sample: zenoh.Sample) -> None:
        channel = str(sample.key_expr).removeprefix(self._root)
        with self._changed:
            self.heard.setdefault(channel, []).append((time.monotonic(), sample.payload.to_bytes()))
            if channel.startswith("map/tile/") and sample.attachment is not None:
                self.versions[channel] = int.from_bytes(sample.attachment.to_bytes()[:8], "little")
            self._changed.notify_all()

    def count(self, channel: str) -> int:
        with self._changed:
            return len(self.heard.get(channel, []))

    def wait_until(self, what: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
        """Evaluates `what` after each sample. Raises AssertionError with the samples received."""
        with self._changed:
            heard = self._changed.wait_for(what, timeout_s)
            assert heard, f"after {timeout_s} s heard { {k: len(v) for k, v in self.heard.items()} }"

    def wait_for(self, channel: str, more: int, timeout_s: float = PATIENCE_S) -> None:
        target = self.count(channel) + more
        self.wait_until(lambda: len(self.heard.get(channel, [])) >= target, timeout_s)

    def get(self, selector: str) -> dict[str, tuple[int, bytes]]:
        """Answers by channel, with their sequence number or version."""
        answers = {}
        for reply in self.session.get(
            self._root + selector, timeout=PATIENCE_S, consolidation=zenoh.ConsolidationMode.NONE
        ):
            assert reply.ok is not None, reply.err
            version = int.from_bytes(reply.ok.attachment.to_bytes()[:8], "little")
            channel = str(reply.ok.key_expr).removeprefix(self._root)
            answers[channel] = (version, reply.ok.payload.to_bytes())
        return answers

    def ask(self, verb: str, **request: object) -> dict[str, Any]:
        """The answer to a command, good or not."""
        (reply,) = self.session.get(
            f"{self._root}cmd/{verb}", payload=json.dumps(request), timeout=PATIENCE_S
        )
        sample = reply.ok if reply.ok is not None else reply.err
        facts: dict[str, Any] = json.loads(sample.payload.to_string())
        assert facts["ok"] is (reply.ok is not None)
        return facts

    def close(self) -> None:
        self.session.close()
