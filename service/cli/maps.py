"""map info, verify, merge: work on stored maps."""

import argparse

from service.cli.console import print_result
from service.errors import UsageError


def map_command(parsed: argparse.Namespace) -> int:
    from service.offline.map_work import map_info, map_merge, map_verify

    match parsed.work:
        case "info":
            print_result(map_info(parsed.map), parsed.json)
        case "verify":
            print_result(map_verify(parsed.map), parsed.json)
        case _:
            if len(parsed.maps) < 2:
                raise UsageError("map merge: name two maps or more")
            if parsed.pair is not None and len(parsed.maps) != 2:
                raise UsageError("map merge: --pair is of two maps")
            print_result(map_merge(parsed.maps, parsed.out, parsed.pair), parsed.json)
    return 0
