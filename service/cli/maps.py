"""map info, verify, log, loops, diff, merge, remap, edit: work on stored maps."""

import argparse
import time
from typing import Any

from service.cli.console import print_result, print_table, progress
from service.errors import UsageError


def map_command(parsed: argparse.Namespace) -> int:
    from service.offline.maps.diff import diff_table, map_diff
    from service.offline.maps.loops import loops_table, map_loops
    from service.offline.maps.work import log_table, map_info, map_log, map_merge, map_verify

    match parsed.work:
        case "info":
            print_result(map_info(*parsed.map), parsed.json)
        case "verify":
            print_result(map_verify(parsed.map), parsed.json)
        case "log":
            log = map_log(parsed.map)
            if parsed.json:
                print_result(log, as_json=True)
            else:
                print_table(log_table(log))
                print_problems(log)
        case "loops":
            loops = map_loops(*parsed.map)
            if parsed.json:
                print_result(loops, as_json=True)
            else:
                print_table(loops_table(loops))
                for pair in loops["pairs"]:
                    print("pair {pair} at ({x_m}, {y_m}) m: {apart_mm} mm apart".format(**pair))
                print_problems(loops)
        case "diff":
            facts = map_diff(parsed.before, parsed.after, parsed.out)
            if not parsed.json:
                rows, facts = diff_table(facts)
                print_table(rows)
            print_result(facts, parsed.json)
        case "edit":
            print_result(_edit(parsed), parsed.json)
        case "remap":
            from service.offline.maps.edit import user_name
            from service.offline.maps.remap import map_remap

            who = parsed.who or user_name()
            with progress("map remap") as shown:
                facts = map_remap(parsed.map, parsed.recordings, parsed.area, who, time.time_ns(), shown)
            print_result(facts, parsed.json)
        case _:
            if len(parsed.maps) < 2:
                raise UsageError("map merge: name two maps or more")
            if parsed.pair is not None and len(parsed.maps) != 2:
                raise UsageError("map merge: --pair is of two maps")
            with progress("map merge") as shown:
                shown(None, "finding where they overlap, and solving")
                merged = map_merge(parsed.maps, parsed.out, parsed.pair)
            print_result(merged, parsed.json)
    return 0


def print_problems(facts: dict[str, Any]) -> None:
    for problem in facts["problems"]:
        print(f"damaged: {problem}")


_ONLY_WITH = {"free": "erase", "unknown": "erase", "bridge": "cut", "keyframes": "add_pair", "to": "undo"}


def _edit(parsed: argparse.Namespace) -> dict[str, Any]:
    from service.offline.maps import edit as map_edit

    for option, change in _ONLY_WITH.items():
        if _is_given(parsed, option) and not _is_given(parsed, change):
            raise UsageError(f"map edit: --{option} goes with --{change.replace('_', '-')}")
    who, now_ns = parsed.who or map_edit.user_name(), time.time_ns()
    if parsed.undo:
        return map_edit.undo(parsed.map, parsed.to, who, now_ns)
    changes = {
        "erase": lambda: map_edit.erase(
            parsed.erase, "free" if parsed.free else "unknown" if parsed.unknown else "as_seen"
        ),
        "wall": lambda: map_edit.wall(parsed.wall),
        "cut": lambda: map_edit.cut(parsed.cut, parsed.bridge),
        "add_pair": lambda: map_edit.add_pairs([(parsed.add_pair, parsed.keyframes)]),
        "remove_pair": lambda: map_edit.remove_pair(parsed.remove_pair),
        "refuse_loop": lambda: map_edit.refuse_loops(parsed.refuse_loop),
        "optimize": map_edit.optimize,
    }
    what = next(name for name in changes if _is_given(parsed, name))
    with progress("map edit") as shown:
        shown(None, "changing the map")
        return map_edit.edit_map(parsed.map, what.replace("_", "-"), changes[what](), who, now_ns)


def _is_given(parsed: argparse.Namespace, option: str) -> bool:
    given = getattr(parsed, option)
    return given is not None and given is not False  # 0 is given
