"""`corridor fleet`: its arguments, and what it calls."""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli.console import print_result

if TYPE_CHECKING:  # it imports pydantic and Zenoh
    from service.publishing.config import PublishingConfig

Add = Callable[[Any, str, str], argparse.ArgumentParser]


def add_fleet(commands: Any, add: Add) -> None:
    works = commands.add_parser("fleet", help="the vehicles of a site, through its router").add_subparsers(
        dest="work", metavar="WORK", required=True
    )
    router = add(works, "router", "the router of the site, until SIGTERM or Ctrl-C")
    router.add_argument(
        "config", type=Path, metavar="ROUTER.yaml", help="its section publishing: listen, security"
    )
    router.add_argument(
        "--zenohd", action="store_true", help="print the config for a zenohd instead, rules included"
    )
    status = add(
        works, "status", "state, pose, map, disk and version of each vehicle; 1 where one is not well"
    )
    status.add_argument("vehicles", nargs="*", metavar="VEHICLE", help="that must be there (default: all)")
    watch = add(works, "watch", "a line with each change, until Ctrl-C; with --json with each health message")
    watch.add_argument("--seconds", type=float, metavar="S", help="end after S seconds")
    for one in (status, watch):
        _add_site(one)


def _add_site(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--site",
        type=Path,
        metavar="SITE.yaml",
        help="its section publishing: connect names the router, security the certificate of who asks "
        "(default: tcp/127.0.0.1:7447)",
    )


def fleet(parsed: argparse.Namespace) -> int:
    works = {"router": _router, "status": _status, "watch": _watch}
    return works[parsed.work](parsed)


def _site(parsed: argparse.Namespace) -> "PublishingConfig | None":
    from service.config import load_publishing

    return None if parsed.site is None else load_publishing(parsed.site)


def _router(parsed: argparse.Namespace) -> int:
    from service.config import load_publishing
    from service.fleet.router import start_router, zenohd_config
    from service.publishing.session import listened_at
    from service.runtime.signals import StopSignals

    config = load_publishing(parsed.config)
    if parsed.zenohd:
        print(zenohd_config(config), end="")
        return 0
    with StopSignals() as stop:
        session = start_router(config)
        print_result({"listen": listened_at(session, config), "session": str(session.zid())}, parsed.json)
        while not stop.wait(3600.0):
            pass
        session.close()  # type: ignore[no-untyped-call]
    return 0


def _status(parsed: argparse.Namespace) -> int:
    from service.fleet.vehicles import connected, read_vehicles

    with connected(_site(parsed)) as session:
        vehicles = read_vehicles(session, parsed.vehicles)
    if parsed.json:
        print(json.dumps({"vehicles": [vehicle.as_dict() for vehicle in vehicles]}, allow_nan=False))
    else:
        print("\n".join(map(str, vehicles)) or "no vehicle at this router")
    return 0 if all(vehicle.is_well for vehicle in vehicles) else 1


def _watch(parsed: argparse.Namespace) -> int:
    from service.fleet.vehicles import Vehicle, connected
    from service.fleet.watch import Watch

    def show(vehicle: Vehicle) -> None:
        print(json.dumps(vehicle.as_dict(), allow_nan=False) if parsed.json else vehicle, flush=True)

    with connected(_site(parsed)) as session:
        Watch(session).run(show, parsed.seconds, changes_only=not parsed.json)
    return 0
