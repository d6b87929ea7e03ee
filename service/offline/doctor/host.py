"""What the machine itself needs: a clock, rights, a unit that starts the service."""

import grp

from drivers.counted import counted
from service.compile.cache import cache_folder, cache_places, is_warm
from service.offline.doctor.findings import Finding, fault, note, ok
from service.offline.doctor.folders import cannot_write, nearest_parent
from service.offline.doctor.machine import Machine
from service.offline.doctor.processes import named
from service.offline.doctor.serial_ports import known_ports

TIME_KEEPERS = ("chronyd", "systemd-timesyncd", "ntpd", "ntpsec", "ptp4l", "phc2sys")
UNIT_FOLDERS = (
    "/etc/systemd/system",
    "/usr/local/lib/systemd/system",
    "/usr/lib/systemd/system",
    "/lib/systemd/system",
)
UNIT = "corridor@.service"
SERIAL_GROUP = "dialout"
BEFORE_THIS_PROGRAM_S = 1_735_689_600  # 2025-01-01
LARGE_CLOCK_ERROR_S = 1.0


def look_at_clock(machine: Machine) -> Finding:
    keepers = named(machine, *TIME_KEEPERS)
    keeper = f"{' and '.join(process.name for process in keepers)} runs" if keepers else "no time daemon runs"
    now_s = machine.unix_s()
    if now_s < BEFORE_THIS_PROGRAM_S:
        return fault(
            "clock",
            f"the clock is {(BEFORE_THIS_PROGRAM_S - now_s) / 86400:.0f} days before 2025; {keeper}",
            "today's date: recordings are named and stamped by it",
            "an empty clock battery? let chrony or systemd-timesyncd set it before the service starts",
        )
    clock = machine.kernel_clock()
    if clock is None:
        return note(
            "clock",
            f"whether the clock is synchronised is unknown: the kernel does not tell here; {keeper}",
            "ask on the host itself: timedatectl",
        )
    if not clock.is_synchronised:
        return note(
            "clock",
            f"the system clock is not synchronised; {keeper}",
            "install chrony; mapping does not need it, but stamps of other machines will not fit",
            "a clock that NTP, PTP or GNSS keeps",
        )
    error = (
        f"{clock.max_error_s * 1e3:.0f} ms"
        if clock.max_error_s < LARGE_CLOCK_ERROR_S
        else f"{clock.max_error_s:.0f} s"
    )
    return ok("clock", f"synchronised, at most {error} off by the kernel's estimate; {keeper}")


def look_at_rights(machine: Machine) -> Finding:
    """The group that owns serial ports on Debian and Ubuntu."""
    ports = known_ports(machine)
    listed = f"; serial ports: {', '.join(ports)}" if ports else "; no USB serial port is plugged in"
    if machine.is_root:
        return ok("rights", f"root may open every port{listed}")
    try:
        group = grp.getgrnam(SERIAL_GROUP)
    except KeyError:
        return note(
            "rights",
            f"there is no group {SERIAL_GROUP} here{listed}",
            "see to which group the ports belong: ls -l /dev/tty*",
        )
    if group.gr_gid in machine.group_ids:
        return ok("rights", f"user {machine.user} is in group {SERIAL_GROUP}{listed}")
    if machine.user in group.gr_mem:
        return note(
            "rights",
            f"user {machine.user} is in group {SERIAL_GROUP}, but was added after this login{listed}",
            "log out and in again",
        )
    return note(
        "rights",
        f"user {machine.user} is not in group {SERIAL_GROUP}, which owns serial ports{listed}",
        f"sudo usermod -aG {SERIAL_GROUP} {machine.user}, then log out and in again",
    )


def look_at_unit(machine: Machine) -> Finding:
    installed = [folder for folder in UNIT_FOLDERS if machine.path(f"{folder}/{UNIT}").exists()]
    if not installed:
        return note(
            "unit",
            f"{UNIT} is not installed: nothing starts the service with the machine",
            "sudo corridor install-unit writes it and says how to enable it",
        )
    wants = machine.path("/etc/systemd/system").glob("*.wants/corridor@*.service")
    enabled = sorted({path.name for path in wants})
    if not enabled:
        return note(
            "unit",
            f"{installed[0]}/{UNIT} is installed, but enabled for no vehicle",
            "sudo systemctl enable --now corridor@<vehicle>",
        )
    return ok("unit", f"{installed[0]}/{UNIT}, enabled: {', '.join(enabled)}")


def look_at_cache(machine: Machine) -> Finding:
    """Finding on numba's cache: its folder, whether it is writable, and the number of compiled kernels."""
    places = cache_places(machine.environment)
    writable = [place for place in places if not cannot_write(nearest_parent(place))]
    if not writable:
        return fault(
            "cache",
            f"user {machine.user} cannot write {' or '.join(map(str, places))}: "
            "kernels are compiled at each start",
            "a folder for compiled kernels",
            "set NUMBA_CACHE_DIR to a folder that this user can write; "
            "the unit takes /var/cache/corridor/numba",
        )
    place = writable[0]
    kernels = sum(1 for _ in cache_folder(place).glob("*.nbi"))
    if not is_warm(place):
        return note(
            "cache",
            f"{counted(kernels, 'kernel')} compiled in {place}, not those of all profiles; "
            "a start compiles what it lacks, up to a minute",
            "corridor warmup",
        )
    return ok("cache", f"the kernels of all profiles are compiled in {place}", kernels=kernels)
