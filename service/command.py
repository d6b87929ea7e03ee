"""Entry point of the program `corridor`. Ctrl-C ends it from here on; slow imports come later."""

import os
import signal

signal.signal(signal.SIGINT, lambda number, frame: os._exit(130))  # before the imports below: they take 50 ms

import sys  # noqa: E402

from service.errors import CalledOffError  # noqa: E402
from service.interruption import (  # noqa: E402
    INTERRUPTED,
    end_at_once,
    end_on_signals,
    leave_signals_alone,
)

# These compile, run long in kernels, which no exception may leave, or begin processes: a signal ends them at
# once. What they write, an end at any moment leaves whole. The others raise KeyboardInterrupt.
ENDED_AT_ONCE = ("run", "demo", "replay", "warmup", "calibrate", "tune", "map", "site")
LIVE = ("run", "demo")


def main() -> None:
    """Run the command line and end the process with its exit code.

    Until a command takes the signals over, SIGINT ends it with 130, SIGTERM and SIGHUP with 128 and their
    number; `run` and `demo` with 0, for being stopped is no failure of a service.
    """
    command = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
    end_on_signals({signal.SIGTERM: 0, signal.SIGHUP: 0} if command in LIVE else {})
    from service.cli import main as run_command

    if command not in ENDED_AT_ONCE:
        leave_signals_alone()
    try:
        code = run_command()
        if code != INTERRUPTED:
            sys.exit(code)
    except CalledOffError as error:
        code = error.exit_code
    sys.stdout.flush()
    end_at_once(code)  # threads may still compile, which no orderly end survives
