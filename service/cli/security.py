"""`corridor security`: its arguments, and what it calls."""

import argparse
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.cli.console import print_report
from service.errors import UsageError

Add = Callable[[Any, str, str], argparse.ArgumentParser]
HOSTS_OF_A_VEHICLE = ("localhost", "127.0.0.1", "::1")  # for programs on board, and the doctor
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@-]{0,63}")
MOST_DAYS = 3650


def add_security(commands: Any, add: Add) -> None:
    works = commands.add_parser("security", help="who may connect to Zenoh and the page").add_subparsers(
        dest="work", metavar="WORK", required=True
    )
    init = add(works, "init", "make and renew the certificates of a site, by its own authority")
    init.add_argument("folder", type=Path, metavar="DIR", help="of the site's files, kept off the vehicles")
    for role, what in (
        ("vehicle", "a vehicle, and its hosts besides NAME, NAME.local and localhost"),
        ("operator", "who may command, and where it is a router the hosts of that"),
        ("viewer", "who may look"),
    ):
        init.add_argument(
            f"--{role}",
            action="append",
            default=[],
            type=_name_and_hosts,
            metavar="NAME[=HOST,...]",
            help=f"a certificate of {what}; may be given several times",
        )
    init.add_argument("--days", type=_days, default=730, metavar="N", help="of each (default: 730)")
    init.add_argument("--renew", action="store_true", help="all, not only those that end within 60 days")


def security(parsed: argparse.Namespace) -> int:
    from drivers.wires import is_host

    try:
        from service.offline.security.authority import Holder, init_site
    except ImportError as error:
        from service.extras import install_command

        raise UsageError(
            f"`corridor security init` needs cryptography ({error}): {install_command('security')}"
        ) from error
    holders = [
        Holder(name, "vehicle", (name, f"{name}.local", *HOSTS_OF_A_VEHICLE, *hosts))
        for name, hosts in parsed.vehicle
    ]
    holders += [Holder(name, "operator", hosts) for name, hosts in parsed.operator]
    holders += [Holder(name, "viewer", hosts) for name, hosts in parsed.viewer]
    for host in (host for holder in holders for host in holder.hosts):
        if not is_host(host):
            raise UsageError(f"{host!r} is neither an IP address nor a host name")
    if len({holder.name for holder in holders}) < len(holders):
        raise UsageError("one name is given twice; each has one role")
    print_report(init_site(parsed.folder, holders, parsed.days, parsed.renew), parsed.json)
    return 0


def _name_and_hosts(text: str) -> tuple[str, tuple[str, ...]]:
    name, _, rest = text.partition("=")
    if _NAME.fullmatch(name) is None or name == "ca":
        raise argparse.ArgumentTypeError(f"{name!r}: a name takes letters, digits and _ . @ -, and is not ca")
    return name, tuple(filter(None, rest.split(",")))


def _days(text: str) -> int:
    if not (text.isdigit() and 1 <= int(text[:6]) <= MOST_DAYS):
        raise argparse.ArgumentTypeError(f"expected 1 to {MOST_DAYS}")
    return int(text)
