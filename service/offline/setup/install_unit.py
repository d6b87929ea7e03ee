"""Installs the files by which systemd and udev start the service with the machine."""

import os
import re
import shutil
import sys
import sysconfig
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from service.config_schema import schema_text
from service.errors import StorageError, UsageError, words_of
from service.resources import CONFIG, SYSTEMD

UNIT_PROGRAM = "/opt/corridor/venv/bin/corridor"  # as it stands in the unit
EXEC_START = re.compile(r"^ExecStart=(.*) run /etc/corridor/%i\.yaml$", re.MULTILINE)
HIDDEN = ("/home/", "/root/", "/tmp/", "/run/user/")  # from the service: ProtectHome=, PrivateTmp=
FILES = {
    SYSTEMD / "corridor@.service": "etc/systemd/system/corridor@.service",
    SYSTEMD / "corridor.sysusers": "etc/sysusers.d/corridor.conf",
    SYSTEMD / "corridor.tmpfiles": "etc/tmpfiles.d/corridor.conf",
    SYSTEMD / "60-corridor.rules": "etc/udev/rules.d/60-corridor.rules",
    CONFIG / "vehicle.yaml": "etc/corridor/vehicle.yaml.example",
}
SCHEMA = "etc/corridor/schema/config.json"  # which the example names
NEXT_STEPS = (
    "systemd-sysusers && systemd-tmpfiles --create",
    "udevadm control --reload && udevadm trigger",
    "systemctl daemon-reload",
    "corridor init --out /etc/corridor/veh1.yaml",
    "systemctl enable --now corridor@veh1",
)


@dataclass(frozen=True, slots=True)
class Installed:
    """Result of `install_unit`. kept: existing files with other content."""

    program: str  # that the unit starts, as systemd reads it; "" where that is not known
    written: list[str]
    unchanged: list[str]
    kept: list[str]
    next_steps: Sequence[str]
    warning: str  # why the service will not start like this; "" where nothing is known

    def __str__(self) -> str:
        lines = [f"wrote {path}" for path in self.written]
        lines += [f"unchanged {path}" for path in self.unchanged]
        lines += [f"kept {path}: it was changed on this machine; --force replaces it" for path in self.kept]
        lines += [f"the unit starts {self.program}"] if self.program else []
        lines += [f"warning: {self.warning}"] if self.warning else []
        return "\n".join([*lines, "next, as root:", *(f"  {step}" for step in self.next_steps)])


def install_unit(root: Path, force: bool = False, program: str | None = None) -> Installed:
    """Write unit, sysusers, tmpfiles, udev rules, an example config and its schema below `root`.

    A file that stands there with other content is kept, unless `force`.

    program    the corridor command that the unit starts, a path below `root`; None: the one that runs now

    Raises UsageError where root is no folder or a unit cannot start the program, StorageError where root
    cannot be written.
    """
    if not root.is_dir():
        raise UsageError(f"--root {root} is no folder; make it, or name the root of the system to set up")
    program = own_program() if program is None else _startable(program)
    written: list[str] = []
    unchanged: list[str] = []
    kept: list[str] = []
    texts = {place: source.read_text(encoding="utf-8") for source, place in FILES.items()}
    for place, text in (texts | {SCHEMA: schema_text()}).items():
        target = root / place
        content = _with_program(text, program)
        try:
            before = target.read_text(encoding="utf-8") if target.exists() else None
            if before == content:
                unchanged.append(str(target))
            elif before is not None and not force:
                kept.append(str(target))
            else:
                _write(target, content)
                written.append(str(target))
        except PermissionError as error:
            raise StorageError(f"{target}: {error.strerror}; run it as root, or give --root DIR") from error
        except (OSError, UnicodeDecodeError) as error:
            raise StorageError(f"{target} cannot be written: {words_of(error)}") from error
    started = _started_by(root / FILES[SYSTEMD / "corridor@.service"])
    return Installed(started, written, unchanged, kept, NEXT_STEPS, _warning(started))


def own_program() -> str:
    """The `corridor` beside this interpreter, as a unit would call it."""
    beside = Path(sysconfig.get_path("scripts")) / "corridor"
    found = str(beside) if beside.exists() else shutil.which("corridor")
    if found is None:
        raise UsageError(f"there is no corridor command beside {sys.executable}; install the package first")
    return os.path.abspath(found)


def _startable(program: str) -> str:
    """The program itself. Raises UsageError."""
    if not program.startswith("/") or not program.isprintable() or set(program) & set("\"'\\"):
        raise UsageError(
            f"--program {program!r}: systemd starts programs by their whole path, without quotes, "
            f"backslashes and control characters; write {UNIT_PROGRAM}, say"
        )
    return program


def _started_by(unit: Path) -> str:
    """The program of an existing unit; "" where it has none."""
    found = EXEC_START.search(unit.read_text(encoding="utf-8"))
    return "" if found is None else found[1].strip('"').replace("%%", "%")


def _with_program(text: str, program: str) -> str:
    """systemd splits at spaces and expands %."""
    quoted = program.replace("%", "%%")
    if re.search(r"\s", quoted):
        quoted = f'"{quoted}"'
    return text.replace(UNIT_PROGRAM, quoted)


def _write(target: Path, content: str) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    fresh = target.with_name(f".{target.name}.new")
    fresh.write_text(content, encoding="utf-8")
    fresh.chmod(0o644)
    fresh.replace(target)


def _warning(program: str) -> str:
    if not program.startswith(HIDDEN):
        return ""
    return (
        f"{program} lies where the unit may not look (ProtectHome=, PrivateTmp=); install it to "
        "/opt/corridor/venv: python3 -m venv /opt/corridor/venv && /opt/corridor/venv/bin/pip install . "
        "in the source tree, and call install-unit from there"
    )
