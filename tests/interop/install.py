"""The wheel as users install it: by uv, by pipx, with the lowest versions, on each processor and Python."""

import json
import re
import subprocess
import sys
from pathlib import Path

from tests.interop.programs import INSTALL_TIMEOUT_S, InteropError, UnavailableError, Venv, environment, run
from tests.recorded_drive import record_office
from tests.system.installed import NOT_OF_THE_CORE, ROOT, build_wheel

PYTHONS = ("3.11", "3.12", "3.13")
EXTRAS = "archive,cluster,export,plot,rerun,tune,viewer"
GLIBC = (2, 28)  # that docs/installation.md asks for
MAX_CORE_MB = 500  # docs/installation.md, "Size"
KERNELS_TIMEOUT_S = 600.0  # compiled by a busy machine
DEMO_S = 5


def wheel_of_the_tree(folder: Path) -> Path:
    """Built at the first call, found again at the next."""
    place = folder / "wheel"
    if not place.exists():
        place.mkdir()
        build_wheel(place)
    (wheel,) = place.glob("corridor-*.whl")
    return wheel


def run_uv(venv: Venv, folder: Path) -> str:
    home = folder / "uv-home"
    wheel = wheel_of_the_tree(folder)
    _install([venv.bin / "uv", "tool", "install", "--python", sys.executable, wheel], home)
    return _look_at(home, home / ".local/share/uv/tools/corridor", venv, folder)


def run_pipx(venv: Venv, folder: Path) -> str:
    home = folder / "pipx-home"
    _install([venv.bin / "pipx", "install", "--python", sys.executable, wheel_of_the_tree(folder)], home)
    (tool,) = home.glob(".local/**/venvs/corridor")
    return _look_at(home, tool, venv, folder)


def _look_at(home: Path, tool: Path, venv: Venv, folder: Path) -> str:
    """Size and content of the venv `tool`; the command that an export without its extra names is run."""
    program = home / ".local/bin/corridor"
    size_mb = int(run(["du", "-sm", str(tool)]).split()[0])
    if size_mb > MAX_CORE_MB:
        raise InteropError(f"the core takes {size_mb} MB, at most {MAX_CORE_MB} are allowed")
    python = str(tool / "bin/python")
    ask = "import sys, importlib.util as u; print(*filter(u.find_spec, sys.argv[1:]))"
    if unwanted := run([python, "-c", ask, *NOT_OF_THE_CORE]).split():
        raise InteropError(f"the core brings {', '.join(unwanted)}")
    result = folder / "replayed-for-install"
    if not result.exists():
        ours = Path(sys.executable).with_name("corridor")
        record_office(folder / "office.mcap", seed=3)
        run([str(ours), "replay", str(folder / "office.mcap"), "--out", str(result)])
    export = [str(program), "export", str(result), "--format", "geotiff", "--out", str(home / "map.tif")]
    refused = subprocess.run(
        export, capture_output=True, text=True, timeout=60, check=False, env=environment(home)
    )
    named = re.search(r"is not installed: (.+)$", refused.stderr, re.MULTILINE)
    if refused.returncode != 1 or named is None:
        raise InteropError(f"export without its extra: exit code {refused.returncode}, {refused.stderr}")
    _install(["sh", "-c", f"PATH={venv.bin}:$PATH; {named[1]}"], home)
    run(export, home)
    return f"{size_mb} MB; geotiff after `{named[1].partition(' ')[0]} ...`, which the error names"


def run_lowest(venv: Venv, folder: Path) -> str:
    """A demo and replays by two profiles with the lowest version of each dependency that we declare."""
    uv, place = venv.bin / "uv", folder / "lowest"
    place.mkdir()
    pinned, python = place / "pinned.txt", place / "venv/bin/python"
    compile_ = [uv, "pip", "compile", "--quiet", "--resolution", "lowest-direct"]
    compile_ += ["--python-version", PYTHONS[0], "--output-file", pinned]
    _install([*compile_, ROOT / "pyproject.toml"], place)
    _install([uv, "venv", "--quiet", "--python", PYTHONS[0], place / "venv"], place)
    into = [uv, "pip", "install", "--quiet", "--python", python]
    _install([*into, "--requirement", pinned], place)
    _install([*into, "--no-deps", wheel_of_the_tree(folder)], place)
    count = pinned.read_text().count("==")
    return f"{count} packages; {map_something(python.with_name('corridor'), place)}"


def map_something(program: Path, folder: Path) -> str:
    """A demo, its replay, a replay by another profile, and the map for nav2. Raises InteropError."""
    demo = [str(program), "demo", "--json", "--seconds", str(DEMO_S), "--out", str(folder / "drive")]
    scans = json.loads(run(demo, folder, KERNELS_TIMEOUT_S))["scans"]
    (recording,) = (folder / "drive").glob("*.mcap")
    replay = [str(program), "replay", "--json", str(recording)]
    replayed = json.loads(run([*replay, "--out", str(folder / "result")], folder, KERNELS_TIMEOUT_S))
    if not replayed["scans"] == scans > 0:
        raise InteropError(f"the demo mapped {scans} scans, its replay {replayed['scans']}")
    other = [*replay, "--profile", "owolm_eskf", "--out", str(folder / "other")]
    run(other, folder, KERNELS_TIMEOUT_S)
    pgm = ["export", str(folder / "result"), "--format", "pgm", "--out", str(folder / "map.pgm")]
    run([str(program), *pgm], folder)
    return f"{scans} scans of a demo mapped, replayed and exported"


def run_wheels(venv: Venv, folder: Path) -> str:
    """pip finds a wheel of each dependency, extras included, for both processors and each Python."""
    needed, newest, count = f"{wheel_of_the_tree(folder)}[{EXTRAS}]", (0, 0), 0
    for machine in ("x86_64", "aarch64"):
        for python in PYTHONS:
            urls = _resolve(venv, needed, machine, python, folder)
            count += len(urls)
            tags = re.findall(rf"manylinux_(\d+)_(\d+)_{machine}\.whl", " ".join(urls))
            newest = max(newest, *((int(major), int(minor)) for major, minor in tags))
    if newest > GLIBC:
        raise InteropError(f"a wheel needs glibc {newest}; docs/installation.md names {GLIBC}")
    return f"{count} wheels, none missing: Python {', '.join(PYTHONS)}; glibc {newest[0]}.{newest[1]}"


def _resolve(venv: Venv, needed: str, machine: str, python: str, folder: Path) -> list[str]:
    """Addresses of the wheels that pip would install there. Raises InteropError where it finds none."""
    report = folder / f"wheels-{machine}-{python}.json"
    platforms = [f"manylinux_2_{minor}_{machine}" for minor in range(5, GLIBC[1] + 1)]
    platforms += [f"manylinux2014_{machine}"]
    command = [str(venv.bin / "python"), "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
    command += ["--only-binary=:all:", "--python-version", python, "--implementation", "cp"]
    command += ["--target", str(folder / "nowhere"), "--report", str(report)]
    for platform in platforms:
        command += ["--platform", platform]
    try:
        run([*command, needed], timeout_s=INSTALL_TIMEOUT_S)
    except InteropError as error:
        if "No matching distribution" in str(error):
            raise InteropError(f"{machine}, Python {python}: {error}") from error
        raise UnavailableError(f"pip: {str(error)[-200:]}") from error
    return [one["download_info"]["url"] for one in json.loads(report.read_text())["install"]]


def _install(command: list[str | Path], home: Path) -> None:
    home.mkdir(exist_ok=True)
    run([str(word) for word in command], home, INSTALL_TIMEOUT_S)
