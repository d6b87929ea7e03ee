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


@pytest.mark.parametrize(
    "line",
    [
        *("Type=notify", "KillMode=mixed", "RestartPreventExitStatus=78", "MemoryDenyWriteExecute=no"),
        "CacheDirectory=corridor",
        "Environment=NUMBA_CACHE_DIR=/var/cache/corridor/numba OPENBLAS_NUM_THREADS=1 PYTHONUNBUFFERED=1",
        *("StartLimitIntervalSec=0", "Restart=on-failure"),  # again and again, without end
        "CPUWeight=500",  # else a busy computer passes scans over
        "OOMPolicy=continue",  # else systemd stops all where the mapper is killed, and no stand-by goes on
        *(f"DeviceAllow=char-{group} rw" for group in ("ttyUSB", "ttyACM")),  # adapters
        *(f"DeviceAllow=char-{group} rw" for group in ("ttyS", "ttyAMA", "ttyTHS", "ttymxc")),  # of the board
    ],
)
def test_the_unit_has_what_the_service_relies_on(line: str):
    assert line in UNIT.read_text().splitlines()


def test_no_command_runs_before_the_service():
    """Its exit status would not be compared with RestartPreventExitStatus=."""
    assert "\nExecStartPre=" not in UNIT.read_text()


def test_the_service_sees_which_processor_it_has():
    """ProcSubset=pid hides /proc/cpuinfo, by which LLVM on ARM and the kernels' cache tell the processor."""
    assert "\nProcSubset=pid" not in UNIT.read_text()


@pytest.mark.parametrize("module", ["usbserial", "cdc_acm"])
@pytest.mark.parametrize("setting", ["After", "Wants"])
def test_a_port_that_is_plugged_in_after_the_start_is_let_in(setting: str, module: str):
    """systemd drops a DeviceAllow= whose group is not in /proc/devices yet, for good."""
    named = " ".join(re.findall(f"^{setting}=(.*)$", UNIT.read_text(), re.MULTILINE)).split()
    assert f"modprobe@{module}.service" in named
