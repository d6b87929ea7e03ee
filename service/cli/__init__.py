"""The `corridor` command. Parses, calls, prints; what a command does stands below."""

import io
import logging
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module

from service.cli.arguments import new_parser
from service.errors import CalledOffError, CorridorError, StorageError
from service.interruption import INTERRUPTED
from service.log_format import printable, set_up_logging

log = logging.getLogger(__name__)

COMPLETION_ASKED = "_ARGCOMPLETE"  # by the shell, see service.cli.completion

# command -> module and function; imported only when called, for numba and Zenoh take a second to import
_COMMANDS = {
    "run": ("service.cli.live", "run"),
    "demo": ("service.cli.live", "demo"),
    "replay": ("service.cli.sessions", "replay"),
    "import": ("service.cli.sessions", "import_log"),
    "recover": ("service.cli.sessions", "recover"),
    "export": ("service.cli.sessions", "export"),
    "report": ("service.cli.sessions", "report"),
    "view": ("service.cli.sessions", "view"),
    "score": ("service.cli.sessions", "score"),
    "calibrate": ("service.cli.sessions", "calibrate"),
    "site": ("service.cli.sessions", "site"),
    "tune": ("service.cli.tuning", "tune"),
    "map": ("service.cli.maps", "map_command"),
    "check": ("service.cli.upkeep", "check"),
    "doctor": ("service.cli.upkeep", "doctor"),
    "init": ("service.cli.upkeep", "init"),
    "install-unit": ("service.cli.upkeep", "install_unit"),
    "security": ("service.cli.security", "security"),
    "fleet": ("service.cli.fleet", "fleet"),
    "warmup": ("service.cli.upkeep", "warmup"),
    "completion": ("service.cli.completion", "completion"),
    "man": ("service.cli.manual", "man"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; its exit code. Raises CalledOffError where a signal came before `run` was ready."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["simulate"]:
        _become_the_simulators(arguments[1:])
    _take_any_name_on_stdout()
    parser = new_parser()
    if COMPLETION_ASKED in os.environ:
        from service.cli.completion import complete

        complete(parser)
    if any(word == "" or (word.startswith("--") and word.endswith("=")) for word in arguments):
        parser.error("an argument is empty; is a variable of the shell not set?")
    try:
        try:
            parsed = parser.parse_args(arguments)
            set_up_logging(logging.DEBUG if parsed.verbose else logging.INFO)
            module, function = _COMMANDS[parsed.command]
            command: Callable[..., int] = getattr(import_module(module), function)
            return command(parsed)
        finally:
            _flush_stdout()
    except CalledOffError:
        raise  # threads still compile: whoever runs the process ends it
    except CorridorError as error:
        print(printable(f"corridor: {error}"), file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:  # `corridor ... | head`
        _give_up_stdout()
        return CorridorError.exit_code
    except OSError as error:
        words = f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)
        print(printable(f"corridor: {words}"), file=sys.stderr)
        return StorageError.exit_code
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception:
        log.exception("corridor %s failed; this is a fault of the program", " ".join(arguments))
        return CorridorError.exit_code


def _take_any_name_on_stdout() -> None:
    """Names of files need be no text of stdout's encoding, nor any text."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def _flush_stdout() -> None:
    """Raises BrokenPipeError, StorageError."""
    try:
        if sys.stdout is not None:  # None: it is closed
            sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        _give_up_stdout()
        raise StorageError(f"stdout: {error.strerror or error}") from error


def _give_up_stdout() -> None:
    """The interpreter would write the rest at its end, and fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _become_the_simulators(arguments: Sequence[str]) -> None:
    """They are a program of their own, which the service must not import."""
    os.execv(sys.executable, [sys.executable, "-m", "simulators", *arguments])
