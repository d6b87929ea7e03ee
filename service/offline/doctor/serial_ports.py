"""A serial port before it is opened: existence, rights, other users, latency timer."""

import grp
import os
import stat
from dataclasses import dataclass
from pathlib import Path

from service.offline.doctor.findings import Finding, fault, note
from service.offline.doctor.machine import Machine
from service.offline.doctor.processes import Process, holders, named

LATENCY_MS = 4  # above it an FTDI adapter bunches messages noticeably; its driver's own choice is 16
_PORT_PATTERNS = ("ttyUSB*", "ttyACM*", "ttyAMA*", "ttyXRUSB*")
MODEM_RULE = (
    'a udev rule with ENV{ID_MM_DEVICE_IGNORE}="1" for this adapter keeps it off; '
    "on a vehicle without a modem: sudo systemctl disable --now ModemManager"
)


@dataclass(frozen=True, slots=True)
class PortLook:
    findings: tuple[Finding, ...]
    can_be_opened: bool


def look_at_port(machine: Machine, who: str, device: str) -> PortLook:
    """`device` is a path; what is reported of it stops at the first thing that keeps it from being opened."""
    path = machine.path(device)
    blocking = (
        _missing(machine, who, device, path)
        or _no_terminal(machine, who, device, path)
        or _no_rights(machine, who, device, path)
        or _busy(machine, who, device, path)
    )
    if blocking is not None:
        return PortLook((blocking,), can_be_opened=False)
    found = [_modem_manager(machine, who, device, path), _latency_timer(machine, who, device, path)]
    return PortLook(tuple(finding for finding in found if finding is not None), can_be_opened=True)


def known_ports(machine: Machine) -> list[str]:
    """Serial ports of this machine, by the names that stay the same where there are such."""
    by_id = machine.path("/dev/serial/by-id")
    named_ports = {link.resolve().name: f"/dev/serial/by-id/{link.name}" for link in sorted(by_id.glob("*"))}
    plain = sorted(port.name for pattern in _PORT_PATTERNS for port in machine.path("/dev").glob(pattern))
    listed = [f"{link} ({port})" for port, link in sorted(named_ports.items())]
    return listed + [f"/dev/{port}" for port in plain if port not in named_ports]


def _list_of_ports(machine: Machine) -> str:
    ports = known_ports(machine)
    return "there are " + ", ".join(ports) if ports else "this machine has no USB serial port at all"


def _missing(machine: Machine, who: str, device: str, path: Path) -> Finding | None:
    if path.exists():
        return None
    if path.is_symlink():
        measured = f"{device} is a link to {os.readlink(path)}, which is not there"
        cause = "the adapter is unplugged or has changed its name"
    else:
        measured = f"{device} is not there"
        cause = "plug the adapter in and look at `dmesg`"
        if device.startswith("/dev/corridor/"):
            cause = "plug the adapter in; if it is in, the udev rule for this name is missing or does not fit"
    ports = _list_of_ports(machine)
    return fault(
        who, f"{measured}; {ports}", "a serial port", f"{cause}, or write the right path as `device`"
    )


def _no_terminal(machine: Machine, who: str, device: str, path: Path) -> Finding | None:
    mode = path.stat().st_mode
    if stat.S_ISCHR(mode):
        return None
    kind = "a folder" if stat.S_ISDIR(mode) else "an ordinary file" if stat.S_ISREG(mode) else "no terminal"
    return fault(
        who,
        f"{device} is {kind}; {_list_of_ports(machine)}",
        "a serial port",
        "write the port's path as `device`; a program that wrote to the port while it was "
        "unplugged leaves a file: remove it",
    )


def _no_rights(machine: Machine, who: str, device: str, path: Path) -> Finding | None:
    if machine.may_read_and_write(path):
        return None
    found = path.stat()
    group = group_name(found.st_gid)
    measured = (
        f"user {machine.user} may not read and write {device}, which is {stat.filemode(found.st_mode)}, "
    )
    measured += f"group {group}"
    if found.st_mode & 0o060 != 0o060:
        remedy = f'a udev rule with GROUP="dialout", MODE="0660" for this port, now: sudo chmod g+rw {device}'
    elif found.st_gid in machine.group_ids:
        remedy = "a container or a sandbox (DeviceAllow= of a unit) keeps this port away; let it in there"
    elif machine.user in members_of(found.st_gid):
        remedy = f"{machine.user} is in group {group} since after this login: log out and in again"
    else:
        remedy = f"sudo usermod -aG {group} {machine.user}, then log out and in again"
    return fault(who, measured, "read and write", remedy)


def _busy(machine: Machine, who: str, device: str, path: Path) -> Finding | None:
    others = [process for process in holders(machine, path.resolve()) if process.number != os.getpid()]
    return busy_finding(who, device, others) if others else None


def busy_finding(who: str, device: str, others: list[Process]) -> Finding:
    """`others` may be empty: the port is busy and the kernel does not report for whom."""
    if not others:
        return fault(
            who,
            f"{device} is held by another user's process, which only root sees",
            "no other program on the port: two readers steal each other's bytes",
            f"sudo fuser -v {device} says who it is; stop that program",
        )
    if any(process.name == "ModemManager" for process in others):
        remedy = f"ModemManager is trying whether this is a modem; wait half a minute. For good: {MODEM_RULE}"
    elif any(process.is_service for process in others):
        remedy = "the service itself is running and uses it; stop it to look at the device"
    else:
        remedy = f"stop {others[0].name}: kill {others[0].number}, or end it where it was started"
    owners = " and ".join(map(str, others))
    return fault(
        who,
        f"{device} is held by {owners}",
        "no other program on the port: two readers steal each other's bytes",
        remedy,
    )


def _modem_manager(machine: Machine, who: str, device: str, path: Path) -> Finding | None:
    number = _device_number(path)
    name = machine.text(f"/sys/dev/char/{number}/uevent")
    if not any(f"DEVNAME={kind}" in name for kind in ("ttyUSB", "ttyACM")):
        return None
    if "E:ID_MM_DEVICE_IGNORE=1" in machine.text(f"/run/udev/data/c{number}"):
        return None
    running = named(machine, "ModemManager")
    if not running:
        return None
    measured = (
        f"{running[0]} runs; at each plug-in it holds {device} for seconds and sends modem commands to it"
    )
    return note(who, measured, MODEM_RULE, "no ModemManager, or one that is told to leave this port alone")


def _latency_timer(machine: Machine, who: str, device: str, path: Path) -> Finding | None:
    where = f"/sys/dev/char/{_device_number(path)}/device/latency_timer"
    text = machine.text(where)
    if not text.isdigit() or int(text) <= LATENCY_MS:
        return None
    return note(
        who,
        f"the FTDI adapter of {device} holds bytes back for up to {text} ms (latency timer)",
        f"echo 1 | sudo tee {where}; for good, a udev rule: "
        'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"',
        "1 ms",
    )


def _device_number(path: Path) -> str:
    number = path.stat().st_rdev
    return f"{os.major(number)}:{os.minor(number)}"


def group_name(group_id: int) -> str:
    try:
        return grp.getgrgid(group_id).gr_name
    except KeyError:
        return str(group_id)


def members_of(group_id: int) -> list[str]:
    try:
        return grp.getgrgid(group_id).gr_mem
    except KeyError:
        return []
