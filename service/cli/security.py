"""`corridor security`: its arguments, and what it calls."""

import argparse
import re
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from service.cli.argument_types import local_path
from service.cli.console import print_report, print_result
from service.errors import UsageError

if TYPE_CHECKING:  # it imports pydantic
    from service.web.tokens import Grant

Add = Callable[[Any, str, str], argparse.ArgumentParser]
HOSTS_OF_A_VEHICLE = ("localhost", "127.0.0.1", "::1")  # for programs on board, and the doctor
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@-]{0,63}")
MOST_DAYS = 3650
DAY_S = 86_400.0


def add_security(commands: Any, add: Add) -> None:
    works = commands.add_parser("security", help="who may connect to Zenoh and the page").add_subparsers(
        dest="work", metavar="WORK", required=True
    )
    init = add(works, "init", "make and renew the certificates of a site, by its own authority")
    init.add_argument(
        "folder", type=local_path, metavar="DIR", help="of the site's files, kept off the vehicles"
    )
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
    tokens = works.add_parser("token", help="further tokens of the page: who may give commands there")
    what_to_do = tokens.add_subparsers(dest="token_work", metavar="WORK", required=True)
    give = add(what_to_do, "add", "make a token and print it once; one of that name before is revoked")
    give.add_argument("name", type=_name, metavar="NAME", help="whose it is")
    give.add_argument(
        "--role",
        choices=("viewer", "operator"),
        help="default: as the one before of that name, else operator",
    )
    give.add_argument("--days", type=_days, metavar="N", help="until it expires (default: never)")
    revoke = add(what_to_do, "revoke", "a token holds no more, at once, also where it was shown before")
    revoke.add_argument("name", type=_name, metavar="NAME", help="whose it is")
    listed = add(what_to_do, "list", "names, roles and days left of the tokens")
    for one in (give, revoke, listed):
        one.add_argument(
            "--token-file",
            type=local_path,
            metavar="PATH",
            help="web.token_file of the service's config (default: web.token in $STATE_DIRECTORY, else in "
            "~/.local/state/corridor); under systemd /var/lib/corridor/web.token",
        )


def security(parsed: argparse.Namespace) -> int:
    works = {"init": _init, "token": _token}
    return works[parsed.work](parsed)


def _token(parsed: argparse.Namespace) -> int:
    from service.web.access import state_folder
    from service.web.tokens import add_grant, granted_beside, read_grants, revoke_grant

    path = granted_beside(parsed.token_file or state_folder() / "web.token")
    now_s = time.time()
    result: dict[str, Any] = {"file": str(path)}
    match parsed.token_work:
        case "add":
            expires_s = now_s + parsed.days * DAY_S if parsed.days is not None else None
            before = {grant.name: grant.role for grant in read_grants(path)}
            role = parsed.role or before.get(parsed.name, "operator")
            result |= {"name": parsed.name, "role": role, "days": parsed.days}
            result |= {"token": add_grant(path, parsed.name, role, expires_s)}
        case "revoke":
            revoke_grant(path, parsed.name)
            result |= {"revoked": parsed.name}
        case _:
            result |= {"tokens": [_shown(grant, now_s) for grant in read_grants(path)]}
    print_result(result, parsed.json)
    return 0


def _shown(grant: "Grant", now_s: float) -> dict[str, Any]:
    end_s = grant.expires_unix_s
    days = None if end_s is None else round((end_s - now_s) / DAY_S, 1)
    return {"name": grant.name, "role": grant.role, "holds": grant.holds(now_s), "days_left": days}


def _init(parsed: argparse.Namespace) -> int:
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
    return _name(name), tuple(filter(None, rest.split(",")))


def _name(name: str) -> str:
    if _NAME.fullmatch(name) is None or name == "ca":
        raise argparse.ArgumentTypeError(f"{name!r}: a name takes letters, digits and _ . @ -, and is not ca")
    return name


def _days(text: str) -> int:
    if not (text.isdigit() and 1 <= int(text[:6]) <= MOST_DAYS):
        raise argparse.ArgumentTypeError(f"expected 1 to {MOST_DAYS}")
    return int(text)
