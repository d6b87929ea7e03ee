"""The wheel of this tree, and the command that is installed from it in a venv of its own."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from service.compile.cache import KERNELS, cache_folder
from tests.docs.blocks import blocks_of

ROOT = Path(__file__).parents[2]
PACKAGES = ("service", "drivers", "simulators")
# Packages of tests and extras: an import of one fails as where it is not installed.
NOT_OF_THE_CORE = (
    "scipy",
    "matplotlib",
    "filterpy",
    "tifffile",
    "ezdxf",
    "foxglove",
    "rerun",
    "dask",
    "upath",
)
TIMEOUT_S = 300.0  # kernels are compiled where those of the tree do not fit


def build_wheel(folder: Path) -> Path:
    """Built from a copy, so that no build folder is left in the tree, and without the network."""
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    leave_out = shutil.ignore_patterns("__pycache__")
    for name in (*PACKAGES, "config", "docs", "systemd"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=leave_out)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--quiet"]
    run([*pip, "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(source)], folder)
    (built,) = folder.glob("corridor-*.whl")
    return built


def install(wheel: Path, folder: Path) -> Path:
    """The command, installed in a venv of its own. Dependencies come from the venv that tests, less those of
    extras and tests; kernels of the same sources come from its cache, where it has them beside the sources.
    """
    venv = folder / "venv"
    run([sys.executable, "-m", "venv", "--without-pip", str(venv)], folder)
    python = venv / "bin" / "python"
    (site,) = (venv / "lib").glob("python*/site-packages")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(python)]
    run([*pip, "install", "--quiet", "--no-deps", "--no-index", str(wheel)], folder)
    # A .pth file in a folder that a .pth file names is not read: the editable install of the tree stays out.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    (site / "sitecustomize.py").write_text(
        f"import sys\nsys.modules.update(dict.fromkeys({NOT_OF_THE_CORE}))\n"
    )
    if (compiled := KERNELS / "__pycache__" / cache_folder().name).exists():
        shutil.copytree(compiled, site / "service" / "kernels" / "__pycache__" / compiled.name)
    return venv / "bin" / "corridor"


def first_commands() -> list[str]:
    """README's first commands, from a wheel to a map for nav2; without comments."""
    block = next(one for one in blocks_of(ROOT / "README.md") if "pipx install" in one.text)
    return [line.partition(" #")[0].strip() for line in block.text.splitlines()]


def environment() -> dict[str, str]:
    """Of a process without the tree in its paths."""
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}


def run(command: list[str], folder: Path) -> str:
    """stdout of a process without the tree in its paths."""
    done = subprocess.run(
        command, cwd=folder, env=environment(), capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout
