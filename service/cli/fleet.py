"""`corridor fleet`: its arguments, and what it calls."""

import argparse
import json
import logging
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from service.cli.argument_types import local_path, map_and_version, positive, vehicle_name
from service.cli.console import print_result, progress
from service.errors import CorridorError, StorageError, words_of
from service.log_format import printable

if TYPE_CHECKING:  # they take long to import
    import zenoh

    from service.fleet.vehicles import Vehicle
    from service.runtime.signals import StopSignals

log = logging.getLogger(__name__)

LOOK_S = 3600.0  # from one look at the router's certificate to the next

Add = Callable[[Any, str, str], argparse.ArgumentParser]


def add_fleet(commands: Any, add: Add) -> None:
    works = commands.add_parser("fleet", help="the vehicles of a site, through its router").add_subparsers(
        dest="work", metavar="WORK", required=True
    )
    router = add(works, "router", "the router of the site, until SIGTERM or Ctrl-C")
    router.add_argument(
        "config", type=local_path, metavar="ROUTER.yaml", help="its section publishing: listen, security"
    )
    router.add_argument(
        "--zenohd", action="store_true", help="print the config for a zenohd instead, rules included"
    )
    status = add(
        works, "status", "state, pose, map, disk and version of each vehicle; 1 where one is not well"
    )
    status.add_argument(
        "vehicles", nargs="*", type=vehicle_name, metavar="VEHICLE", help="that must be there (default: all)"
    )
    watch = add(works, "watch", "a line with each change, until Ctrl-C; with --json with each health message")
    watch.add_argument("--seconds", type=positive, metavar="S", help="end after S seconds")
    page = add(works, "page", "all vehicles on one map, on the operator's page, until Ctrl-C")
    page.add_argument(
        "--map",
        type=local_path,
        metavar="MAP",
        help="the stored map of the site (default: the vehicles' tiles)",
    )
    page.add_argument(
        "--listen", default="127.0.0.1:8080", metavar="HOST:PORT", help="default: 127.0.0.1:8080"
    )
    pull = add(
        works, "pull", "fetch the finished recordings of vehicles, oldest first; goes on where it ended"
    )
    pull.add_argument("vehicles", nargs="*", type=vehicle_name, metavar="VEHICLE", help="default: all")
    pull.add_argument(
        "--out", type=local_path, required=True, metavar="DIR", help="a folder for each vehicle in it"
    )
    pull.add_argument("--limit-mb-s", type=positive, metavar="MB", help="of each vehicle's link, at most")
    push = add(works, "push", "bring a stored map to vehicles; all begin in it, or none stays in it")
    push.add_argument("map", type=map_and_version, metavar="MAP[@VERSION]", help="its folder")
    push.add_argument("vehicles", nargs="+", type=vehicle_name, metavar="VEHICLE")
    push.add_argument("--name", metavar="NAME", help="of the map there (default: FOLDER_vVERSION)")
    for one in (status, watch, page, pull, push):
        one.add_argument(
            "--site",
            type=local_path,
            metavar="SITE.yaml",
            help="its section publishing: connect names the router, security the certificate of who asks "
            "(default: tcp/127.0.0.1:7447)",
        )


def fleet(parsed: argparse.Namespace) -> int:
    works = {"status": _status, "watch": _watch, "page": _page, "pull": _pull, "push": _push}
    if parsed.work == "router":
        return _router(parsed)
    if parsed.work == "page":
        from service.cli.sessions import check_listen

        check_listen(parsed.listen)
    from service.config import load_publishing
    from service.fleet.vehicles import connected

    with connected(None if parsed.site is None else load_publishing(parsed.site)) as session:
        return works[parsed.work](parsed, session)


def _router(parsed: argparse.Namespace) -> int:
    from service.config import load_publishing
    from service.fleet.router import start_router, zenohd_config
    from service.publishing.certificate import validity_of
    from service.publishing.session import listened_at
    from service.runtime.signals import StopSignals

    config = load_publishing(parsed.config)
    if parsed.zenohd:
        print(zenohd_config(config), end="")
        return 0
    validity = validity_of(config.secured)
    with StopSignals() as stop, closing(start_router(config)) as session:
        print_result({"listen": listened_at(session, config), "session": str(session.zid())}, parsed.json)
        sys.stdout.flush()
        while True:
            if fault := validity.fault():
                log.warning("%s", fault)
            if stop.wait(LOOK_S):
                return 0


def _wait(stop: "StopSignals") -> None:
    sys.stdout.flush()
    while not stop.wait(3600.0):
        pass


def _status(parsed: argparse.Namespace, session: "zenoh.Session") -> int:
    from service.fleet.vehicles import read_vehicles

    vehicles = read_vehicles(session, parsed.vehicles)
    if parsed.json:
        print_result({"vehicles": [vehicle.as_dict() for vehicle in vehicles]}, as_json=True)
    else:
        print(printable("\n".join(map(str, vehicles)) or "no vehicle at this router"))
    return 0 if all(vehicle.is_well for vehicle in vehicles) else 1


def _watch(parsed: argparse.Namespace, session: "zenoh.Session") -> int:
    from service.fleet.watch import Watch

    def show(vehicle: "Vehicle") -> None:
        line = json.dumps(vehicle.as_dict(), allow_nan=False) if parsed.json else printable(vehicle)
        print(line, flush=True)

    Watch(session).run(show, parsed.seconds, changes_only=not parsed.json)
    return 0


def _page(parsed: argparse.Namespace, session: "zenoh.Session") -> int:
    from service.fleet.page import FleetPage
    from service.runtime.signals import StopSignals

    with StopSignals() as stop, closing(FleetPage(session, parsed.listen, parsed.map)) as page:
        print_result({"address": page.address}, parsed.json)
        _wait(stop)
    return 0


def _pull(parsed: argparse.Namespace, session: "zenoh.Session") -> int:
    from service.fleet.pull import Pulled, pull
    from service.fleet.queries import for_each, namesakes
    from service.fleet.vehicles import present

    limit = None if parsed.limit_mb_s is None else parsed.limit_mb_s * 1e6
    sizes: dict[str, tuple[int, int]] = {}
    here = present(session)
    with progress("recordings") as shown:

        def fetch(vehicle: str) -> Pulled:
            def come(done: int, total: int) -> None:
                sizes[vehicle] = done, total
                all_done, all_bytes = (sum(column) for column in zip(*list(sizes.values()), strict=True))
                shown(all_done / all_bytes, "recordings", f"{all_done / 1e6:.0f} MB")

            if (why := namesakes(here.get(vehicle, ()))) is not None:
                raise why
            try:
                return pull(session, vehicle, parsed.out, limit, come)
            except OSError as error:
                where = parsed.out / vehicle
                raise StorageError(
                    f"cannot write to {where}: {words_of(error)}; what is there stays"
                ) from error

        results = for_each(parsed.vehicles or list(here), fetch)
    if not results:
        log.warning("no vehicle at this router, nothing is fetched; expected one at least, see fleet status")
    report = {
        one: {"error": str(result)} if isinstance(result, CorridorError) else asdict(result)
        for one, result in results.items()
    }
    print_result({"vehicles": report}, parsed.json)
    return next((one.exit_code for one in results.values() if isinstance(one, CorridorError)), 0)


def _push(parsed: argparse.Namespace, session: "zenoh.Session") -> int:
    from service.fleet.push import push

    folder, number = parsed.map
    pushed = push(session, folder, number, parsed.vehicles, parsed.name, lambda words: log.info("%s", words))
    if parsed.json:
        report = {one.vehicle: {"state": one.state, "error": one.error} for one in pushed}
        print_result({"vehicles": report}, as_json=True)
    else:
        print("\n".join(map(str, pushed)))
    return 0 if all(one.state == "active" for one in pushed) else 1
