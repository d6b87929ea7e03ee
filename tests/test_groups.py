import re
from itertools import product
from pathlib import Path

import pytest

from tests import groups
from tests.groups import GROUPS, Group, run

ROOT = Path(__file__).parents[1]
PASSES = "def test_a():\n    pass\n"
FAILS = "def test_b():\n    raise AssertionError('it is broken')\n"
HANGS = """
import threading

def wait_for_ever():
    threading.Event().wait()

def test_d():
    threading.Thread(target=wait_for_ever).start()
"""
WAITS = """
from pathlib import Path
from tests.waiting import wait_until

def test_e():
    wait_until(Path("{path}").exists)
"""
SKIPS = "import pytest\n\ndef test_c():\n    pytest.skip('no laser here; plug one in')\n"


@pytest.fixture(autouse=True)
def signals_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.groups.signal.signal", lambda number, handler: None)


@pytest.fixture(autouse=True)
def pytest_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without plugins, which take longer to load than the rest of such a session."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")


def group(folder: Path, name: str, text: str) -> Group:
    path = folder / f"test_{name}.py"
    path.write_text(text)
    return Group(name, (str(path), "-c", "/dev/null", f"--rootdir={folder}"), niceness=0)


def test_each_group_has_its_line_failures_are_printed_whole_and_skips_have_their_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    made = [("a", PASSES), ("b", FAILS), ("c", SKIPS), ("empty", "")]
    assert run([group(tmp_path, *one) for one in made], tmp_path / "logs") == 1
    printed = capsys.readouterr().out
    assert re.search(r"^a: exit code 0 after \d+ s, \d+ s of processor: 1 passed", printed, re.MULTILINE)
    assert "it is broken" in printed
    assert "skipped 1: no laser here; plug one in" in printed
    assert printed.splitlines()[-1] == "FAILED: b, empty"


def test_groups_that_all_pass_end_with_success_and_keep_their_compiled_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """Compiled files are kept even where the environment forbids it."""
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    assert run([group(tmp_path, "a", PASSES)], tmp_path / "logs") == 0
    assert capsys.readouterr().out.splitlines()[-1] == "all passed"
    assert list((tmp_path / "__pycache__").glob("test_a.*.pyc"))


def test_a_group_that_hangs_after_its_tests_ends_with_the_stacks_of_its_threads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(groups, "MAX_SILENCE_S", 12.0)
    monkeypatch.setattr(groups, "LOOK_S", 0.01)
    assert run([group(tmp_path, "h", HANGS)], tmp_path / "logs") == 1
    said = capsys.readouterr().out
    assert "h: exit code -6" in said
    assert "in wait_for_ever" in said


def test_a_failure_is_named_while_its_group_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(groups, "TELL_S", 0.0)
    monkeypatch.setattr(groups, "LOOK_S", 0.01)
    heard, named = [], tmp_path / "named"

    def say(words: str) -> None:
        heard.append(words)
        if words.startswith("FAILED "):
            named.touch()

    monkeypatch.setattr(groups, "say", say)
    assert run([group(tmp_path, "b", FAILS + WAITS.format(path=named))], tmp_path / "logs") == 1
    line = "FAILED test_b.py::test_b - AssertionError: it is broken"
    assert heard.count(line) == 1
    assert any("1 failed, 1 passed" in words for words in heard)


def test_every_test_is_in_exactly_one_group():
    service = next(one for one in GROUPS if one.name == "service")
    others = [one for one in GROUPS if one is not service]
    named = [path for one in others for path in one.paths]
    assert sorted(service.arguments) == sorted(f"--ignore={path}" for path in named)
    assert all((ROOT / path).exists() for path in named)
    assert len(set(named)) == len(named)
    within = {
        (one.name, f"--ignore={inner}")
        for one, inner in product(others, named)
        if any(inner.startswith(f"{outer}/") for outer in one.paths)
    }
    left_to_others = {(one.name, option) for one in others for option in set(one.arguments) - set(one.paths)}
    assert left_to_others == within
