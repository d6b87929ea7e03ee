"""What conftest.py does for a whole session, seen from a session of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WANTS = {  # fixture -> the command that brings what it gives
    "shared": "CORRIDOR_SHARED=FOLDER make test",
    "chromium": "sudo apt install chromium chromium-driver",
    "axe": "make axe",
}


@pytest.mark.parametrize(("is_needed", "exit_code", "counted"), [("", 0, "3 skipped"), ("1", 1, "3 errors")])
def test_what_is_missing_is_a_skip_with_the_command_that_brings_it_and_a_failure_where_it_is_needed(
    is_needed: str, exit_code: int, counted: str, tmp_path: Path
):
    tests = [f"def test_{fixture}({fixture}):\n    raise AssertionError('it is here')\n" for fixture in WANTS]
    (tmp_path / "test_it.py").write_text("\n".join(tests))
    options = ["-q", "-rsE", "-p", "tests.conftest", "-p", "tests.browser.conftest"]
    environment = {
        "CORRIDOR_SHARED": str(tmp_path),
        "CORRIDOR_AXE": str(tmp_path / "axe.js"),
        "CORRIDOR_NEEDS_SHARED": is_needed,
        "CORRIDOR_NEEDS_BROWSER": is_needed,
        "PATH": str(tmp_path),  # no chromium there
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # they take longer to load than the rest
    }
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, "-c", os.devnull, f"--rootdir={tmp_path}", str(tmp_path)],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == exit_code, done.stdout + done.stderr
    assert counted in done.stdout
    assert [command for command in WANTS.values() if command not in done.stdout] == []
