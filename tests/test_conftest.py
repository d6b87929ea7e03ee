"""What conftest.py does for a whole session, seen from a session of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WANTS_RECORDINGS = (
    "tests/drivers/test_sick_lms100_protocol.py::test_every_recorded_telegram_is_decoded_and_encoded_back"
)


@pytest.mark.parametrize(("needs_shared", "exit_code"), [("", 0), ("1", 1)])
def test_want_of_real_recordings_is_a_skip_here_and_a_failure_where_they_are_needed(
    needs_shared: str, exit_code: int, tmp_path: Path
):
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", WANTS_RECORDINGS],
        cwd=ROOT,
        env=os.environ | {"CORRIDOR_SHARED": str(tmp_path), "CORRIDOR_NEEDS_SHARED": needs_shared},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == exit_code, done.stdout
    assert f"no real recordings at {tmp_path}; set CORRIDOR_SHARED" in done.stdout
