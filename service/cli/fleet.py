"""`corridor fleet`: its arguments, and what it calls."""

import argparse
import json
import logging
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli.console import print_result, progress
from service.cli.map_names import map_and_version
from service.errors import CorridorError, UsageError

if TYPE_CHECKING:  # it imports pydantic and Zenoh
    from service.publishing.config import PublishingConfig

log = logging.getLogger(__name__)

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
    page = add(works, "page", "all vehicles on one map, on the operator's page, until Ctrl-C")
    page.add_argument(
        "--map", type=Path, metavar="MAP", help="the stored map of the site (default: the vehicles' tiles)"
    )
    page.add_argument(
        "--listen", default="127.0.0.1:8080", metavar="HOST:PORT", help="default: 127.0.0.1:8080"
    )
    pull = add(
        works, "pull", "fetch the finished recordings of vehicles, oldest first; goes on where it ended"
    )
    pull.add_argument("vehicles", nargs="*", metavar="VEHICLE", help="default: all")
    pull.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="a folder for each vehicle in it"
    )
    pull.add_argument("--limit-mb-s", type=float, metavar="MB", help="of each vehicle's link, at most")
    push = add(works, "push", "bring a stored map to vehicles; all begin in it, or none stays in it")
    push.add_argument("map", type=map_and_version, metavar="MAP[@VERSION]", help="its folder")
    push.add_argument("vehicles", nargs="+", metavar="VEHICLE")
    push.add_argument("--name", metavar="NAME", help="of the map there (default: FOLDER_vVERSION)")
    for one in (status, watch, page, pull, push):
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
    works = {"router": _router, "status": _status, "watch": _watch, "page": _page}
    works |= {"pull": _pull, "push": _push}
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
        sys.stdout.flush()
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


def _page(parsed: argparse.Namespace) -> int:
    from service.cli.sessions import check_listen
    from service.fleet.page import FleetPage
    from service.fleet.vehicles import connected
    from service.runtime.signals import StopSignals

    check_listen(parsed.listen)
    with StopSignals() as stop, connected(_site(parsed)) as session:
        page = FleetPage(session, parsed.listen, parsed.map)
        print_result({"address": page.address}, parsed.json)
        sys.stdout.flush()
        while not stop.wait(3600.0):
            pass
        page.close()
    return 0


def _pull(parsed: argparse.Namespace) -> int:
    from service.fleet.asking import for_each, namesakes
    from service.fleet.pull import Pulled, pull
    from service.fleet.vehicles import connected, present

    if parsed.limit_mb_s is not None and not parsed.limit_mb_s > 0.0:
        raise UsageError(f"--limit-mb-s {parsed.limit_mb_s:g}: give a rate above 0")
    limit = None if parsed.limit_mb_s is None else parsed.limit_mb_s * 1e6
    sizes: dict[str, tuple[int, int]] = {}
    with connected(_site(parsed)) as session, progress("recordings") as shown:
        here = present(session)

        def fetch(vehicle: str) -> Pulled:
            def come(done: int, total: int) -> None:
                sizes[vehicle] = done, total
                all_done, all_bytes = (sum(column) for column in zip(*list(sizes.values()), strict=True))
                shown(all_done / all_bytes, "recordings", f"{all_done / 1e6:.0f} MB")

            if (why := namesakes(here.get(vehicle, ()))) is not None:
                raise why
            return pull(session, vehicle, parsed.out, limit, come)

        results = for_each(parsed.vehicles or list(here), fetch)
    if not results:
        log.warning(
            "no vehicle at this router, nothing is fetched; expected one at least, see fleet status"
        )
    print_result({"vehicles": {one: _result(result) for one, result in results.items()}}, parsed.json)
    return next((one.exit_code for one in results.values() if isinstance(one, CorridorError)), 0)


def _push(parsed: argparse.Namespace) -> int:
    from service.fleet.push import push
    from service.fleet.vehicles import connected

    folder, number = parsed.map
    with connected(_site(parsed)) as session:
        pushed = push(
            session, folder, number, parsed.vehicles, parsed.name, lambda words: log.info("%s", words)
        )
    if parsed.json:
        print_result(
            {"vehicles": {one.vehicle: {"state": one.state, "error": one.error} for one in pushed}}, True
        )
    else:
        print("\n".join(map(str, pushed)))
    return 0 if all(one.state == "active" for one in pushed) else 1


def _result(result: Any) -> dict[str, Any]:
    return {"error": str(result)} if isinstance(result, CorridorError) else asdict(result)
