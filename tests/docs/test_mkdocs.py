"""The manual builds as a site."""

import subprocess
import sys
from pathlib import Path

CONFIG = Path(__file__).parents[2] / ".ci" / "mkdocs.yml"


def test_mkdocs_builds_the_manual_without_warnings(tmp_path: Path) -> None:
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", CONFIG, "-d", tmp_path / "site"],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert built.returncode == 0, built.stderr
    assert (tmp_path / "site" / "estimator" / "index.html").exists()
