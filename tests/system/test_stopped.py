"""The end of a service while its processes stand still."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from service.deadline import HUNG_S
from tests.processes import alive, look_at
from tests.system.machine import PATIENCE_S, LiveService, free_port
from tests.waiting import wait_until

EXIT_S = 7.0  # of an interpreter on a busy machine; 0.3 s on an idle one


@pytest.mark.parametrize(("number", "is_replaced"), [(signal.SIGTERM, False), (signal.SIGKILL, True)])
def test_nothing_of_a_service_that_is_ended_lives_on_where_all_of_its_processes_are_stopped(
    tmp_path: Path, number: signal.Signals, is_replaced: bool
):
    """Be the mapper the one that the service began, or a stand-by that has replaced it."""
    service = LiveService(
        tmp_path, {"front": {"type": "sick_lms100", "host": "127.0.0.1", "port": free_port()}}
    )
    its: list[int] = []
    process = subprocess.Popen(
        [Path(sys.executable).parent / "corridor", "run", service.config],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"NOTIFY_SOCKET": service.systemd.address},
    )
    try:
        service.systemd.wait_for("READY=1", PATIENCE_S)
        (mapper,) = (one.pid for one in alive() if one.parent == process.pid)

        def of_mapper() -> list[int]:
            return [one.pid for one in alive() if one.session == mapper]

        its += of_mapper()
        assert len(its) >= 4  # with a stand-by, and a back end for each
        if is_replaced:
            os.kill(mapper, signal.SIGKILL)
            wait_until(lambda: len(set(of_mapper()) - set(its)) >= 2, words="no further stand-by")
            its[:] = of_mapper()
        for pid in its:
            os.kill(pid, signal.SIGSTOP)
        began_s = time.monotonic()
        process.send_signal(number)
        _, log = process.communicate(timeout=PATIENCE_S)  # until stdout is closed, too, which they all have
        assert time.monotonic() - began_s < HUNG_S + EXIT_S, log
        assert process.returncode == (0 if number == signal.SIGTERM else -number), log  # nothing is lost
        wait_until(lambda: not any(map(look_at, its)), words="they live on")
    finally:
        process.kill()
        process.communicate()
        for pid in filter(look_at, its):
            os.kill(pid, signal.SIGKILL)
        service.close()
