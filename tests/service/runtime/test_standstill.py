import os
import signal
import subprocess
import sys

from service.runtime.standstill import Standstill
from tests.waiting import wait_until


def test_a_process_that_is_stopped_stands_still_and_one_that_computes_does_not():
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as process:
        try:
            standstill = Standstill()
            wait_until(lambda: standstill.seconds(process.pid) == 0.0)
            os.kill(process.pid, signal.SIGSTOP)
            wait_until(lambda: standstill.seconds(process.pid) > 0.05)
            os.kill(process.pid, signal.SIGCONT)
            wait_until(lambda: standstill.seconds(process.pid) == 0.0)
        finally:
            process.kill()


def test_time_counts_again_after_a_word():
    standstill = Standstill()
    wait_until(lambda: standstill.seconds(0) > 0.05)  # no such process
    standstill.reset()
    assert standstill.seconds(0) < 0.05
