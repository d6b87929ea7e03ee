"""The package, README's first commands and the Containerfile in a fresh Debian each; needs root."""

import os
import re
import shlex
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from service.mapstore.ros_map import read_ros_map
from service.outputs import OCCUPIED
from tests.interop.install import KERNELS_TIMEOUT_S, wheel_of_the_tree
from tests.interop.programs import INSTALL_TIMEOUT_S, InteropError, UnavailableError, run
from tests.interop.programs import ROOT as VENVS
from tests.recorded_drive import record_office
from tests.system.installed import ROOT, first_commands

SUITE = "bookworm"
PACKAGE = ROOT / "systemd/package"
TOOLS = ("debootstrap", "unshare", "chroot", "dpkg-deb", "lintian")
CERTIFICATES = "PIP_CERT"  # of the registry, where this machine has its own
DEMO_AND_REPLAY = """
corridor demo --seconds 5 --out drive
corridor replay drive/*.mcap --out result
test -s result/map.pgm
"""
MAX_PACKAGE_MB = 450


@dataclass(frozen=True, slots=True)
class Debian:
    """A Debian of debootstrap, kept under .venv-interop; each check gets a copy."""

    name: str

    @property
    def base(self) -> Path:
        return VENVS / self.name

    def ensure(self) -> None:
        """Make it where it is not there yet. Raises UnavailableError."""
        if os.geteuid() != 0:
            raise UnavailableError("needs root, for debootstrap and chroot")
        if missing := [tool for tool in TOOLS if shutil.which(tool) is None]:
            raise UnavailableError(f"apt install debootstrap lintian; missing: {', '.join(missing)}")
        if (self.base / "installed").exists():
            return
        shutil.rmtree(self.base, ignore_errors=True)
        self.base.parent.mkdir(exist_ok=True)
        try:
            run(["debootstrap", "--variant=minbase", SUITE, str(self.base)], timeout_s=INSTALL_TIMEOUT_S)
        except InteropError as error:
            raise UnavailableError(str(error)[-200:]) from error
        (self.base / "installed").touch()

    def version(self, _: str) -> str:
        return (self.base / "etc/debian_version").read_text().strip()


@dataclass(frozen=True, slots=True)
class Machine:
    """A copy of a Debian, in which commands run as in a container that has the network of its host."""

    root: Path

    def run(
        self, command: str, user: str = "root", timeout_s: float = INSTALL_TIMEOUT_S, home: str = ""
    ) -> str:
        """stdout of a shell command of this user. Raises InteropError."""
        home = home or ("/root" if user == "root" else f"/home/{user}")
        clean = f"env -i HOME={home} PATH=/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin LC_ALL=C.UTF-8"
        settings = "DEBIAN_FRONTEND=noninteractive PIP_DISABLE_PIP_VERSION_CHECK=1"
        if CERTIFICATES in os.environ:
            settings += f" {CERTIFICATES}=/etc/pip-cert.pem"
        root = shlex.quote(str(self.root))
        inside = f"chroot --userspec={user} {root} {clean} {settings}"
        inside += f" sh -c {shlex.quote(f'set -e; cd {home}; {command}')}"
        # Its own /proc and terminals; all its processes end with the shell.
        kinds = {"proc": "proc", "tmpfs": "dev/shm", "devpts": "dev/pts"}
        mounts = [f"mount -t {kind} {kind} {root}/{place}" for kind, place in kinds.items()]
        mounted = " && ".join([*mounts, f"exec {inside}"])
        unshare = ["unshare", "--mount", "--pid", "--fork", "--kill-child"]
        return run([*unshare, "sh", "-c", mounted], timeout_s=timeout_s)

    def add_user(self) -> Path:
        """User `driver`; the home folder, seen from outside."""
        self.run("useradd --create-home driver")
        return self.root / "home/driver"


@contextmanager
def machine(debian: Debian, folder: Path) -> Iterator[Machine]:
    root = folder / "machine"
    run(["cp", "-a", str(debian.base), str(root)])
    shutil.copy("/etc/resolv.conf", root / "etc")
    if certificates := os.environ.get(CERTIFICATES):
        shutil.copy(certificates, root / "etc/pip-cert.pem")
    fresh = Machine(root)
    try:
        fresh.run("apt-get update -q")
    except InteropError as error:
        shutil.rmtree(root)
        raise UnavailableError(f"apt: {str(error)[-200:]}") from error
    try:
        yield fresh
    finally:
        shutil.rmtree(root)


def run_deb(debian: Debian, folder: Path) -> str:
    """Built, judged by lintian, installed, used, upgraded, removed and purged."""
    package = _package(folder)
    tags = run(["lintian", "--allow-root", "--fail-on", "error", str(package)], timeout_s=INSTALL_TIMEOUT_S)
    warnings = len(re.findall(r"^W:", tags, re.MULTILINE))
    with machine(debian, folder) as fresh:
        fresh.add_user()
        shutil.copy(package, fresh.root / "tmp/1.deb")
        fresh.run("apt-get install -y -q --no-install-recommends /tmp/1.deb")
        size_mb = int(fresh.run("du -sm /usr/lib/corridor").split()[0])
        if size_mb > MAX_PACKAGE_MB:
            raise InteropError(f"the package takes {size_mb} MB, at most {MAX_PACKAGE_MB} are allowed")
        fresh.run("corridor check /etc/corridor/vehicle.yaml.example; getent passwd corridor")
        fresh.run("test -s /usr/share/man/man1/corridor-replay.1.gz")
        fresh.run("bash -n /usr/share/bash-completion/completions/corridor")
        fresh.run(DEMO_AND_REPLAY, "driver", KERNELS_TIMEOUT_S)
        _upgrade_and_purge(fresh, package)
    sizes = f"{package.stat().st_size / 1e6:.0f} MB, {size_mb} MB installed"
    return f"{sizes}; lintian: no error, {warnings} warnings; upgraded and purged"


def _package(folder: Path) -> Path:
    out = folder / "package"
    script = [sys.executable, str(PACKAGE / "build_deb.py"), str(wheel_of_the_tree(folder))]
    run([*script, "--out", str(out)], timeout_s=INSTALL_TIMEOUT_S)
    (package,) = out.glob("*.deb")
    return package


def _upgrade_and_purge(fresh: Machine, package: Path) -> None:
    """What people made or changed stays; all else goes. Raises InteropError."""
    content, newer = package.parent / "content", package.parent / "newer.deb"
    run(["dpkg-deb", "--raw-extract", str(package), str(content)])
    control = content / "DEBIAN/control"
    control.write_text(re.sub(r"^(Version: \S+)-1$", r"\1-2", control.read_text(), flags=re.MULTILINE))
    run(["dpkg-deb", "-Zgzip", "-z1", "--build", str(content), str(newer)], timeout_s=INSTALL_TIMEOUT_S)
    shutil.move(newer, fresh.root / "tmp/2.deb")
    fresh.run("echo '# mine' >> /etc/corridor/vehicle.yaml.example; touch /etc/corridor/veh1.yaml")
    fresh.run("touch /var/lib/corridor/maps/mine")
    fresh.run("apt-get install -y -q --no-install-recommends /tmp/2.deb")
    fresh.run("dpkg-query -W corridor | grep -- '-2$'; corridor --version")
    fresh.run("grep mine /etc/corridor/vehicle.yaml.example")
    fresh.run("apt-get remove -y -q corridor; test ! -e /usr/lib/corridor; test ! -e /usr/bin/corridor")
    fresh.run("grep mine /etc/corridor/vehicle.yaml.example")
    fresh.run("apt-get purge -y -q corridor; rm /tmp/*.deb")
    left = fresh.run(
        r"find / -xdev \( -path /proc -o -path /home \) -prune -o -name '*corridor*' -print"
    ).split()
    kept = fresh.run("find /etc/corridor /var/lib/corridor -type f").split()
    mine = ["/etc/corridor/veh1.yaml", "/var/lib/corridor/maps/mine"]
    if sorted(left) != ["/etc/corridor", "/var/lib/corridor"] or sorted(kept) != mine:
        raise InteropError(f"after the purge there are {left} and {kept}")


def run_readme(debian: Debian, folder: Path) -> str:
    """README's commands from the wheel to a map for nav2, as a user of a fresh Debian types them."""
    commands = first_commands()
    with machine(debian, folder) as fresh:
        home = fresh.add_user()
        shutil.copy(wheel_of_the_tree(folder), home)
        record_office(home / "drive.mcap", seed=3)
        for command in commands:
            if command.startswith("sudo "):
                fresh.run(command.removeprefix("sudo ").replace("apt install", "apt-get install -y -q"))
        typed = [command for command in commands if not command.startswith("sudo ")]
        began_s = time.monotonic()
        fresh.run("; ".join(typed), "driver", INSTALL_TIMEOUT_S + KERNELS_TIMEOUT_S)
        cells = read_ros_map(home / "hall.yaml").cells
        if (cells == OCCUPIED).sum() < 100:
            raise InteropError("the map of README's commands has no walls")
        return f"{len(commands)} commands, {time.monotonic() - began_s:.0f} s after apt, kernels compiled"


def run_containerfile(debian: Debian, folder: Path) -> str:
    """The steps of the Containerfile in a chroot, as no engine is asked for; then its program maps."""
    with machine(debian, folder) as fresh:
        text = (PACKAGE / "Containerfile").read_text(encoding="utf-8").replace("\\\n", " ")
        environment, user, folder_there = "", "root", ""
        for line in text.splitlines():
            instruction, _, words = line.partition(" ")
            match instruction:
                case "RUN":
                    fresh.run(words)
                case "COPY":
                    place = fresh.root / words.split()[-1].strip("/")
                    place.mkdir(parents=True, exist_ok=True)
                    shutil.copy(wheel_of_the_tree(folder), place)
                case "ENV":
                    environment = words
                case "USER":
                    user = words
                case "WORKDIR":
                    folder_there = words
                case "" | "#" | "FROM" | "VOLUME" | "ENTRYPOINT" | "CMD":
                    pass  # judged by an engine only
                case other:
                    raise InteropError(f"{other} of the Containerfile is not known here")
        fresh.run(f"export {environment}; {DEMO_AND_REPLAY}", user, KERNELS_TIMEOUT_S, folder_there)
        size_mb = int(fresh.run("du -sxm / --exclude=/proc").split()[0])
        return f"its steps in a chroot, a demo mapped and replayed by {user}; {size_mb} MB with Debian"
