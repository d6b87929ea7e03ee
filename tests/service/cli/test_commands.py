import io
import json
import logging
import os
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from service import log_format
from service.cli import console, main
from service.errors import ConfigError, CorridorError, InputError, StorageError, UsageError
from service.runtime.metrics import Percentiles
from service.runtime.summary import Summary
from service.version import VERSION
from tests.service.cli.test_status_line import Terminal

GOOD = """\
vehicle: v
sensors: {front: {type: sick_lms100, host: a}}
recording: {directory: s}
map: {directory: m}
"""
URL = (
    "is a URL; expected a path on this machine. Copy the file: only replay, tune and site build read "
    "recordings by URLs, and only replay --out may be one"
)
CORRIDOR = Path(sys.executable).parent / "corridor"


@pytest.fixture
def good(tmp_path: Path) -> Path:
    path = tmp_path / "good.yaml"
    path.write_text(GOOD)
    return path


def code_of(arguments: list[str]) -> int:
    """Exit code, also where argparse leaves by itself."""
    try:
        return main(arguments)
    except SystemExit as left:
        return left.code if isinstance(left.code, int) else -1


@pytest.mark.parametrize(("warm", "words"), [(True, "all compiled"), (False, "some are compiled when .*")])
def test_the_version_is_the_one_that_stands_in_one_place(
    warm: bool, words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("service.compile.cache.is_warm", lambda: warm)
    assert code_of(["--version"]) == 0
    first, *others = capsys.readouterr().out.splitlines()
    assert first == f"corridor {VERSION}"
    assert re.fullmatch(f"kernels [0-9a-f]{{12}}: {words}", others[-1])


def test_bash_completes_commands_options_names_and_files(tmp_path: Path):
    (tmp_path / "vehicle.yaml").write_text(GOOD)
    lines = {
        "corridor re": "replay report recover",
        "corridor replay --prof": "--profile",
        "corridor replay --profile c": "contour_lm corridor",
        "corridor check v": "vehicle.yaml",
    }
    script = 'source <(corridor completion bash); for COMP_LINE in "$@"; do COMP_POINT=${#COMP_LINE}; '
    script += 'COMP_TYPE=9; _python_argcomplete corridor; echo "${COMPREPLY[*]}"; done'
    path = f"{CORRIDOR.parent}:{os.environ['PATH']}"
    ran = subprocess.run(
        ["bash", "-c", script, "bash", *lines],
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert [line.strip() for line in ran.stdout.splitlines()] == list(lines.values()), ran.stderr


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ([], ""),
        (["drive"], ""),
        (["run"], ""),
        (["demo", "--seconds", "0"], ""),
        (["demo", "--world", "ofice"], ""),
        (["replay"], ""),
        (["replay", "a.mcap", "--rate", "-1"], ""),
        (["replay", "a.mcap", "--profile", "corridr"], ""),
        (["export", "x", "--format", "jpeg", "--out", "y"], ""),
        (["demo", "--seconds", "soon"], "argument --seconds: 'soon' is no number"),
        (["demo", "--seconds", "1e9"], "argument --seconds: 1e9 is not above 0 and below 1e+09"),
        (["demo", "--port", "http"], "argument --port: 'http' is no whole number"),
        (["replay", "a.mcap", "--rate", "fast"], "argument --rate: 'fast' is no number; give one, or max"),
        (["import", "rosbag", "a.bag", "s3://site/a.mcap"], URL),
        (["calibrate", "s3://site/a.mcap"], URL),
        (["replay", "a.mcap", "--map", "s3://site/map@3"], URL),
        (["replay", ""], "an argument is empty; is a variable of the shell not set?"),
        (["replay", "a.mcap", "--out="], "an argument is empty; is a variable of the shell not set?"),
    ],
)
def test_wrong_usage_exits_with_64_in_plain_words(
    wrong: list[str], words: str, capsys: pytest.CaptureFixture[str]
):
    assert code_of(wrong) == UsageError.exit_code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "usage: corridor" in printed.err
    assert printed.err.endswith(f" {words}\n" if words else "\n")


def test_the_command_itself_ends_with_this_code_and_without_a_traceback():
    done = subprocess.run([CORRIDOR, "drive"], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (UsageError.exit_code, "")
    assert done.stderr.startswith("usage: corridor")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("code", "heavy"),
    [
        ("import service.cli; service.cli.new_parser()", {"numba", "numpy", "zenoh", "pydantic"}),
        ("import service.runtime.run", {"gtsam", "scipy", "matplotlib", "numba"}),
    ],
    ids=["help", "run"],
)
def test_nothing_is_imported_that_takes_its_time_before_it_is_needed(code: str, heavy: set[str]):
    command = [sys.executable, "-c", f"import sys; {code}; print(*sys.modules)"]
    loaded = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert not heavy & set(loaded.stdout.split())


FRONT = "front: {type: sick_lms100, host: a}"
TWO = f"{FRONT}, rear: {{type: hokuyo_utm30lx, host: b}}, imu: {{type: xsens_mtig, device: /dev/imu}}"
BASE = "base: {type: irobot_create, device: /dev/b}"


@pytest.mark.parametrize(
    ("sensors", "mapped", "words"),
    [
        (FRONT, ["front"], "front is mapped"),
        (TWO, ["front", "rear"], "front and rear are mapped"),
        (
            TWO.replace("host: a", "host: a, map: false"),
            ["rear"],
            "rear is mapped; scans of front are published and recorded, not mapped",
        ),
        (BASE, [], "no laser is mapped"),
    ],
)
def test_check_says_which_lasers_are_mapped(sensors, mapped, words, good, capsys):
    good.write_text(GOOD.replace(FRONT, sensors))
    assert main(["check", str(good)]) == 0
    assert capsys.readouterr().out.startswith(f"{good}: ok; {words}")
    assert main(["check", str(good), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["mapped_lasers"] == mapped


def test_check_lists_every_fault_and_exits_with_78(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    bad = tmp_path / "bad.yaml"
    bad.write_text(GOOD.replace("vehicle: v", "vehicle: V") + "maping: {}\n")
    assert main(["check", str(bad)]) == ConfigError.exit_code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.splitlines()) == 2
    assert main(["check", str(bad), "--json"]) == ConfigError.exit_code
    answer = json.loads(capsys.readouterr().out)
    assert (answer["ok"], len(answer["faults"])) == (False, 2)


def test_run_refuses_a_bad_config_before_anything_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["run", str(tmp_path / "nowhere.yaml")]) == ConfigError.exit_code
    assert "nowhere.yaml: cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (CorridorError("x"), 1),
        (InputError("x"), 65),
        (StorageError("x"), 74),
        (OSError(28, "No space left on device"), 74),
        (ConfigError(["x"]), 78),
        (ZeroDivisionError("x"), 1),
        (KeyboardInterrupt(), 130),
    ],
)
def test_each_error_has_its_exit_code(
    error: BaseException, code: int, good: Path, monkeypatch: pytest.MonkeyPatch
):
    def fail(path: Path) -> None:
        raise error

    monkeypatch.setattr("service.config.load_config", fail)
    assert main(["run", str(good)]) == code


def incomplete(*arguments: object, **more: object) -> Summary:
    """A run whose map lacks something."""
    nothing = Percentiles(0.0, 0.0, 0.0, 0.0)
    return Summary(1.0, 30, 0, {}, nothing, nothing, {}, 0.0, {}, 0, failure="the map lacks loops")


def test_a_run_that_lacks_something_ends_with_1_after_its_result(
    good: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for place in ("service.runtime.run.run", "service.demo.run"):
        monkeypatch.setattr(place, incomplete)
    laser = {"name": "front", "device": "sick_lms100", "endpoint": "tcp://127.0.0.1:2111"}
    fakes = SimpleNamespace(endpoints=[laser], fault=str, left_out={})
    monkeypatch.setattr("service.demo.simulators", lambda options, truth: nullcontext(fakes))
    for command in (["run", str(good)], ["demo", "--no-web", "--out", str(good.parent / "out")]):
        assert main([*command, "--json"]) == 1
        out, err = capsys.readouterr()
        facts = json.loads(out)
        assert (facts["scans"], facts["failure"]) == (30, "the map lacks loops")
        assert err.splitlines()[-1] == "corridor: the map lacks loops"


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_names_that_stdout_cannot_encode_are_printed_with_escapes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoding: str
):
    stdout = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", stdout)
    assert main(["man", os.fsdecode(bytes(tmp_path / "\u0142") + b"\xff")]) == 0
    stdout.seek(0)
    assert "\\udcff/corridor.1" in stdout.read()


PRINTS = ["completion", "bash"]  # a command that is done at once


def test_a_reader_that_has_gone_is_no_crash():
    with subprocess.Popen([CORRIDOR, *PRINTS], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""


@pytest.mark.parametrize("command", [["--help"], PRINTS])
def test_a_result_that_cannot_be_written_is_a_storage_error(command: list[str]):
    with Path("/dev/full").open("w") as full:
        env = {**os.environ, "PYTHONUNBUFFERED": ""}  # the buffer is written at the end
        done = subprocess.run([CORRIDOR, *command], stdout=full, stderr=subprocess.PIPE, env=env, check=False)
    assert done.returncode == StorageError.exit_code
    assert done.stderr.decode() == "corridor: stdout: No space left on device\n"


def test_the_bar_says_how_long_the_rest_takes_once_the_pace_is_known():
    clock_s, terminal = [0.0], Terminal()
    shown = console.Progress("mapping", terminal, lambda: clock_s[0])
    for clock_s[0], share in ((1.0, 0.01), (2.0, 0.02), (30.0, 0.25), (120.0, 1.0)):
        shown(share)
    shown(0.5, "closing loops")
    shown.end()
    ends = [line.partition("] ")[2] for line in terminal.getvalue().split(console.CLEAR)[1:]]
    assert ends == ["  1%", "  2%, 1 %/s, 1:38 left", " 25%, 0.83 %/s, 1:30 left", "100%\n", " 50%\n"]


def test_each_phase_of_a_work_has_a_line_of_its_own():
    terminal, pipe = Terminal(), io.StringIO()
    for stream in (terminal, pipe):
        shown = console.Progress("mapping", stream)
        for share, phase in ((0.5, "compiling kernels"), (0.4, "mapping"), (1.0, "mapping")):
            shown(share, phase)
        shown(None, "closing loops")
        shown(None, "closing loops")
        shown.end()
    bars = [line.rpartition(console.CLEAR)[2] for line in terminal.getvalue().split("\n")]
    assert bars[0] == "compiling kernels [###############...............]  50%"
    assert bars[1] == f"mapping [{'#' * 30}] 100%"
    assert bars[2:] == ["closing loops ...", ""]
    assert pipe.getvalue().splitlines() == [
        *("compiling kernels: 50%", "mapping: 40%", "mapping: 100%", "closing loops ...")
    ]


def test_results_are_words_or_one_json_object(capsys: pytest.CaptureFixture[str]):
    result = {
        "scans": 3,
        "scan_ms": {"p50": 0.12345678},
        "map": None,
        "is_whole": True,
        "problems": [],
        "versions": [1, 2],
        "merged": [{"map": "a", "residual_mm": {"rms": 0.7}}, {"map": "b"}],
    }
    console.print_result(result, as_json=False)
    assert capsys.readouterr().out.splitlines() == [
        "scans: 3",
        "scan_ms.p50: 0.123457",
        "is_whole: yes",
        "problems: none",
        "versions: 1, 2",
        "merged.1.map: a",
        "merged.1.residual_mm.rms: 0.7",
        "merged.2.map: b",
    ]
    console.print_result(result, as_json=True)
    assert json.loads(capsys.readouterr().out) == result


def test_names_in_foreign_files_do_not_steer_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    name, shown = "a\x1b[2Jb\r\x9b", r"a\x1b[2Jb\r\x9b"
    assert main(["replay", str(tmp_path / name)]) == InputError.exit_code
    console.print_result({"name": name, "names": [{"a": name}]}, as_json=False)
    console.print_table([["", name], [name, "1"]])
    console.print_report(name, as_json=False)
    logging.getLogger("service").warning("%s", name)
    out, err = capsys.readouterr()
    assert (out.count(shown), err.count(shown)) == (5, 3)
    assert not [c for c in out + err if ord(c) < 32 and c != "\n"]


def test_the_journal_is_reported_the_severity(monkeypatch: pytest.MonkeyPatch):
    record = logging.LogRecord("drivers.link", logging.WARNING, "", 0, "gone\nback", None, None)
    assert (
        log_format.JournalFormatter("%(name)s: %(message)s").format(record) == "<4>drivers.link: gone\n  back"
    )
