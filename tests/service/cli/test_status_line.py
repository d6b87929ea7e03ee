import io
import logging
import re
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from service.cli.status_line import CLEAR, PLAIN_S, StatusLine, status_line
from service.geometry.se2 import SE2
from service.runtime.metrics import Percentiles
from service.runtime.summary import RunningStatus
from tests.set_clock import SetClock

OK = RunningStatus(
    "ok", "ok", SE2(1.234, -5.0, 1.5707963), {"front": 50.0, "imu": 199.6}, Percentiles(1.9, 3.0, 43.4, 50.0),
    (24.0, 18.0), 12,
)  # fmt: skip


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def service(running_status: RunningStatus | None = OK, kernels_compiled: float = 0.0) -> Any:
    return SimpleNamespace(running_status=running_status, kernels_compiled=kernels_compiled)


def test_the_running_status_names_state_pose_rates_latency_and_map():
    assert str(OK) == (
        "ok | x 1.23 y -5.00 m, 90 deg | front 50 imu 200 Hz | latency 1.9 ms, p99 43 | "
        "map 24 x 18 m, 12 tiles"
    )
    lost = RunningStatus(
        "lost", "few beams agree", None, {"front": 0.0}, Percentiles(0, 0, 0, 0), (0.0, 0.0), 0
    )
    assert str(lost) == "lost | front 0 Hz | few beams agree"


def test_on_a_terminal_the_line_is_written_again_in_its_place():
    terminal, clock = Terminal(), SetClock()
    line = StatusLine(terminal, clock)
    line(service(None))
    clock.now_s += 0.4
    line(service(None, 0.5))  # too early
    clock.now_s += 0.2
    line(service(None, 0.5))
    clock.now_s += 1.0
    line(service())
    lines = [part.rstrip("\r") for part in terminal.getvalue().split(CLEAR)]
    assert lines[1] == "loading kernels, 0 s"
    assert re.fullmatch(r"compiling kernels \[#{15}\.{15}\]  50% 1 s", lines[2])
    assert lines[3].startswith("0 s | ok | x 1.23")
    assert "\n" not in terminal.getvalue()
    line.end()
    assert terminal.getvalue().endswith(CLEAR)


def test_elsewhere_it_is_a_line_of_the_log_now_and_then(caplog: pytest.LogCaptureFixture):
    pipe, clock = io.StringIO(), SetClock()
    line = StatusLine(pipe, clock, is_reported_elsewhere=False)
    with caplog.at_level(logging.INFO):
        for _ in range(25):
            line(service())
            clock.now_s += 1.0
    assert len(caplog.messages) == 25 // PLAIN_S + 1
    assert caplog.messages[1].startswith("10 s | ok | ")
    assert pipe.getvalue() == ""


@pytest.fixture
def terminal_log() -> Iterator[Terminal]:
    terminal = Terminal()
    handler = logging.StreamHandler(terminal)
    logging.getLogger().addHandler(handler)
    yield terminal
    logging.getLogger().removeHandler(handler)


def test_what_is_logged_goes_above_the_line(terminal_log: Terminal):
    with status_line(terminal_log) as line:
        line(service())
        logging.getLogger("x").warning("front: cable out")
    written = terminal_log.getvalue()
    lines, logged, again = written.split(CLEAR)[1:4]
    assert lines == again
    assert lines.startswith("0 s | ok")
    assert logged == "front: cable out\n"
    assert written.endswith(CLEAR)
    logging.getLogger("x").warning("afterwards")
    assert terminal_log.getvalue().endswith(f"{CLEAR}afterwards\n")
