"""Ending at once, by whichever thread hears of it."""

import subprocess
import sys

TWO_THREADS = """
import threading
from service.interruption import before_ending, end_at_once

is_cleaning = threading.Event()

def clean():
    print("cleans", flush=True)
    is_cleaning.set()
    second.join(0.3)  # which would do it once more meanwhile

def end_too():
    is_cleaning.wait()
    end_at_once(3)

second = threading.Thread(target=end_too)
before_ending(clean)
before_ending(lambda: print("last", flush=True))
second.start()
end_at_once(2)
"""


def test_of_two_threads_one_cleans_up_and_ends_it() -> None:
    done = subprocess.run([sys.executable, "-c", TWO_THREADS], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr, done.returncode) == ("cleans\nlast\n", "", 2)
