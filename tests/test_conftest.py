"""What conftest.py does for a whole session, seen from a session of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WANTS_RECORDINGS = "def test_it(shared):\n    raise AssertionError('there are recordings')\n"


@pytest.mark.parametrize(("needs_shared", "exit_code"), [("", 0), ("1", 1)])
def test_want_of_real_recordings_is_a_skip_here_and_a_failure_where_they_are_needed(
    needs_shared: str, exit_code: int, tmp_path: Path
):
    (tmp_path / "test_it.py").write_text(WANTS_RECORDINGS)
    options = ["-q", "-rs", "-p", "tests.conftest", "-c", os.devnull, f"--rootdir={tmp_path}"]
    environment = {
        "CORRIDOR_SHARED": str(tmp_path),
        "CORRIDOR_NEEDS_SHARED": needs_shared,
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # they take longer to load than the rest
    }
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, str(tmp_path / "test_it.py")],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == exit_code, done.stdout + done.stderr
    assert f"no real recordings at {tmp_path}; set CORRIDOR_SHARED" in done.stdout
