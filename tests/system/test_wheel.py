"""The wheel alone, in a venv outside the tree: what a vehicle needs may not lie in the repository only."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from service.kernel_cache import DIGEST_NAME, KERNELS
from service.version import VERSION

ROOT = Path(__file__).parents[2]
PACKAGES = ("service", "drivers", "simulators")
TIMEOUT_S = 300.0  # kernels are compiled where those of the tree do not fit


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, so that no build folder is left in the tree, and without the network."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    leave_out = shutil.ignore_patterns("__pycache__")
    for name in (*PACKAGES, "config", "systemd"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=leave_out)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--quiet"]
    run([*pip, "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(source)], folder)
    (built,) = folder.glob("corridor-*.whl")
    return built


@pytest.fixture(scope="module")
def corridor(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command, installed in a venv of its own. Dependencies come from the venv that tests; kernels of the
    same sources come from its cache, where it has them beside the sources.
    """
    folder = tmp_path_factory.mktemp("installed")
    venv = folder / "venv"
    run([sys.executable, "-m", "venv", "--without-pip", str(venv)], folder)
    python = venv / "bin" / "python"
    (site,) = (venv / "lib").glob("python*/site-packages")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(python)]
    run([*pip, "install", "--quiet", "--no-deps", "--no-index", str(wheel)], folder)
    # A .pth file in a folder that a .pth file names is not read: the editable install of the tree stays out.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    compiled = KERNELS / "__pycache__"
    if (compiled / DIGEST_NAME).exists():
        installed = site / "service" / "kernels"
        for kernel in KERNELS.glob("*.py"):  # numba takes what it compiled for another time of the source
            changed = kernel.stat()
            os.utime(installed / kernel.name, ns=(changed.st_atime_ns, changed.st_mtime_ns))
        (installed / "__pycache__").mkdir(exist_ok=True)
        for path in (compiled / DIGEST_NAME, *compiled.glob("*.nb[ci]")):
            shutil.copy2(path, installed / "__pycache__")
    return venv / "bin" / "corridor"


def run(command: list[str], folder: Path) -> str:
    """stdout, of a process that knows nothing of the tree."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout


def test_the_wheel_holds_every_file_of_the_packages(wheel: Path):
    tracked = subprocess.run(
        ["git", "ls-files", *PACKAGES, "config", "systemd"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    if tracked.returncode != 0:
        pytest.skip("no git, or no repository: which files belong to the packages is not known")
    links = {f"service/resources/{name}" for name in ("config", "systemd")}
    expected = {
        f"service/resources/{name}" if name.startswith(("config/", "systemd/")) else name
        for name in tracked.stdout.splitlines()
        if name not in links and (ROOT / name).exists()
    }
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    assert len(expected) > 250
    assert expected - held == set()


def test_it_runs_from_anywhere(corridor: Path, tmp_path: Path):
    assert run([str(corridor), "--version"], tmp_path) == f"corridor {VERSION}\n"
    where = "import service, drivers, simulators; print(service.__file__)"
    assert str(corridor.parents[1]) in run([str(corridor.with_name("python")), "-c", where], tmp_path)


@pytest.mark.timeout(TIMEOUT_S)
def test_it_maps_a_demo_and_replays_what_was_recorded(corridor: Path, tmp_path: Path):
    told = json.loads(run([str(corridor), "demo", "--seconds", "2", "--json", "--out", "out"], tmp_path))
    assert told["scans"] > 0  # a busy machine passes many over
    assert (tmp_path / told["map"] / "map.yaml").exists()
    replayed = json.loads(run([str(corridor), "replay", told["session"], "--json", "--out", "r"], tmp_path))
    assert replayed["scans"] == told["scans"]
    assert (tmp_path / "r" / "map.png").exists()


def test_it_sets_a_machine_up(corridor: Path, tmp_path: Path):
    run([str(corridor), "install-unit", "--root", str(tmp_path)], tmp_path)
    unit = (tmp_path / "etc/systemd/system/corridor@.service").read_text()
    assert f"ExecStart={corridor} run /etc/corridor/%i.yaml" in unit
    example = tmp_path / "etc/corridor/vehicle.yaml.example"
    assert f"{example}: ok; front is mapped" in run([str(corridor), "check", str(example)], tmp_path)
