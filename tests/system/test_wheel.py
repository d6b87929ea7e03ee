"""The wheel alone, in a venv outside the tree: what a vehicle needs may not lie in the repository only."""

import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from service.mapstore.ros_map import read_ros_map
from service.outputs import OCCUPIED
from service.version import VERSION
from tests.demo_run import DemoRun
from tests.system.installed import PACKAGES, ROOT, TIMEOUT_S, first_commands, run

PROGRAM = Path(__file__).with_name("typed_program.py")  # of a user


def test_the_wheel_holds_every_file_of_the_packages(wheel: Path):
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("which files belong to the packages git knows: apt install git, and test in a clone")
    command = ["git", "ls-files", *PACKAGES, "config", "docs", "systemd", ":!systemd/package"]
    tracked = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=60, check=True)
    links = {f"service/resources/{name}" for name in ("config", "docs", "systemd")}
    expected = {
        f"service/resources/{name}"
        if name.startswith(("config/", "docs/", "systemd/"))
        else name.removeprefix("service/python/")
        for name in tracked.stdout.splitlines()
        if name not in links and (ROOT / name).exists()
    }
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    assert len(expected) > 250
    assert expected - packed == set()


def test_it_runs_from_anywhere(corridor: Path, tmp_path: Path):
    version, kernels = run([str(corridor), "--version"], tmp_path).splitlines()  # no commit
    assert version == f"corridor {VERSION}"
    assert kernels.startswith("kernels ")
    where = "import corridor, service, drivers, simulators; print(corridor.__file__, service.__file__)"
    places = run([str(corridor.with_name("python")), "-c", where], tmp_path).split()
    assert [str(corridor.parents[1]) in place for place in places] == [True, True]


@pytest.mark.soak  # against the sources: `make check`
@pytest.mark.timeout(TIMEOUT_S)
def test_a_program_is_checked_by_mypy_against_the_installed_types(corridor: Path, tmp_path: Path):
    shutil.copy(PROGRAM, tmp_path)
    mypy = [sys.executable, "-m", "mypy", "--strict", "--python-executable"]
    assert "Success" in run([*mypy, str(corridor.with_name("python")), PROGRAM.name], tmp_path)


@pytest.mark.timeout(TIMEOUT_S)
def test_the_first_commands_of_readme_lead_from_what_its_demo_recorded_to_a_map_for_nav2(
    corridor: Path, demo_run: DemoRun, tmp_path: Path
):
    facts = demo_run.summary
    assert facts["scans"] > 0  # a busy machine passes many over
    assert (Path(facts["map"]) / "map.yaml").exists()
    commands = first_commands()
    assert len(commands) <= 6
    shutil.copy(facts["session"], tmp_path / "drive.mcap")
    typed = [command.split() for command in commands if command.startswith("corridor ")]
    assert [words[1] for words in typed] == ["replay", "export"]
    for _, *arguments in typed:
        run([str(corridor), *arguments], tmp_path)
    assert json.loads((tmp_path / "hall" / "summary.json").read_text())["scans"] == facts["scans"]
    assert (tmp_path / "hall" / "map.png").exists()
    assert (read_ros_map(tmp_path / "hall.yaml").cells == OCCUPIED).sum() > 100


def test_it_sets_a_machine_up(corridor: Path, tmp_path: Path):
    run([str(corridor), "install-unit", "--root", str(tmp_path)], tmp_path)
    unit = (tmp_path / "etc/systemd/system/corridor@.service").read_text()
    assert f"ExecStart={corridor} run /etc/corridor/%i.yaml" in unit
    example = tmp_path / "etc/corridor/vehicle.yaml.example"
    assert f"{example}: ok; front is mapped" in run([str(corridor), "check", str(example)], tmp_path)
