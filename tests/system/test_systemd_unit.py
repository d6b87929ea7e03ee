"""The unit as systemd itself reads it; no booted systemd is needed."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

UNIT = Path(__file__).parents[2] / "systemd" / "corridor@.service"
MAX_EXPOSED = 25  # of 100; a unit without any hardening has 96


@pytest.fixture
def rendered(tmp_path: Path) -> Path:
    """The unit with a program that exists on this machine, or a skip where systemd-analyze does not."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze; on Debian and Ubuntu: apt install systemd")
    unit = tmp_path / "corridor@veh1.service"
    program = shutil.which("true")
    assert program is not None
    unit.write_text(UNIT.read_text().replace("/opt/corridor/venv/bin/corridor", program))
    return unit


def test_systemd_accepts_the_unit(rendered: Path):
    verified = subprocess.run(
        ["systemd-analyze", "verify", str(rendered)], capture_output=True, text=True, timeout=60, check=False
    )
    assert verified.stderr == ""
    assert verified.returncode == 0


def test_the_unit_is_well_closed(rendered: Path):
    command = ["systemd-analyze", "security", "--offline=true", f"--threshold={MAX_EXPOSED}", str(rendered)]
    judged = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert judged.returncode == 0, judged.stdout + judged.stderr


def test_the_unit_says_what_the_service_relies_on():
    text = UNIT.read_text()
    assert (
        "\nExecStartPre=" not in text
    )  # its exit status would not be held against RestartPreventExitStatus=
    for line in ("Type=notify", "KillMode=mixed", "RestartPreventExitStatus=78", "MemoryDenyWriteExecute=no"):
        assert re.search(f"^{line}$", text, re.MULTILINE), line
    assert "NUMBA_CACHE_DIR=/var/cache/corridor/numba" in text
    assert "CacheDirectory=corridor" in text


@pytest.mark.parametrize(("group", "module"), [("ttyUSB", "usbserial"), ("ttyACM", "cdc_acm")])
def test_a_port_that_is_plugged_in_after_the_start_is_let_in(group: str, module: str):
    """systemd drops a DeviceAllow= whose group is not in /proc/devices yet, for good."""
    text = UNIT.read_text()
    assert re.search(f"^DeviceAllow=char-{group} rw$", text, re.MULTILINE)
    for setting in ("After", "Wants"):
        named = " ".join(re.findall(f"^{setting}=(.*)$", text, re.MULTILINE)).split()
        assert f"modprobe@{module}.service" in named


@pytest.mark.parametrize("group", ["ttyS", "ttyAMA", "ttyTHS", "ttymxc"])
def test_the_uarts_of_the_board_are_let_in(group: str):
    assert re.search(f"^DeviceAllow=char-{group} rw$", UNIT.read_text(), re.MULTILINE)


def test_a_service_that_fails_again_and_again_is_started_again_without_end():
    text = UNIT.read_text()
    assert re.search("^StartLimitIntervalSec=0$", text, re.MULTILINE)
    assert re.search("^Restart=on-failure$", text, re.MULTILINE)


def test_a_mapper_killed_for_want_of_memory_leaves_its_place_to_the_stand_by():
    """systemd's own way is to stop the whole service."""
    assert re.search("^OOMPolicy=continue$", UNIT.read_text(), re.MULTILINE)
