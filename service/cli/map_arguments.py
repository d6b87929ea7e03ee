"""Arguments of `corridor map`."""

import argparse
from collections.abc import Callable
from typing import Any

from service.cli.argument_types import local_path, map_and_version

Add = Callable[[Any, str, str], argparse.ArgumentParser]


def add_maps(commands: Any, add: Add) -> None:
    works = commands.add_parser("map", help="work on stored maps").add_subparsers(
        dest="work", metavar="WORK", required=True
    )
    info = add(works, "info", "what a stored map holds")
    info.add_argument("map", type=map_and_version, metavar="MAP[@VERSION]")
    for name, what in (
        ("verify", "read every version against its checksums"),
        ("log", "the versions of a stored map: when, who, what"),
    ):
        add(works, name, what).add_argument("map", type=local_path, metavar="MAP")
    loops = add(works, "loops", "the loops of a stored map, accepted and refused, with place and evidence")
    loops.add_argument("map", type=map_and_version, metavar="MAP[@VERSION]")
    diff = add(works, "diff", "what changed between two versions of a map, or two maps in one frame")
    for name in ("before", "after"):
        diff.add_argument(name, type=map_and_version, metavar=f"{name.upper()}[@VERSION]")
    diff.add_argument("--out", type=local_path, metavar="FILE.png", help="a picture of it")
    merge = add(works, "merge", "several maps to one, in the frame of the first")
    merge.add_argument("maps", type=local_path, nargs="+", metavar="MAP")
    merge.add_argument("--out", type=local_path, required=True, metavar="C", help="folder of the new map")
    merge.add_argument(
        "--pair",
        type=float,
        nargs=6,
        metavar=("X1", "Y1", "DEG1", "X2", "Y2", "DEG2"),
        help="one spot in the first map and the same in the second, to 2 m and 10 deg, where too little "
        "overlaps to be found",
    )
    remap = add(works, "remap", "drive an area of a map again: what the recording saw of it takes its place")
    remap.add_argument("map", type=local_path, metavar="MAP")
    remap.add_argument("recordings", type=local_path, nargs="+", metavar="FILE.mcap", help="of one drive")
    remap.add_argument(
        "--area",
        type=float,
        nargs="+",
        required=True,
        metavar="M",
        help="X Y X Y X Y ...: corners of the area, m in the map; outside of it nothing changes",
    )
    remap.add_argument("--who", metavar="NAME", help="who makes the change (default: the user's name)")
    _add_edit(add(works, "edit", "change a stored map by hand; each change is a version, and none is lost"))


def _add_changes(change: Any) -> None:
    """One of which an edit makes."""
    change.add_argument(
        "--erase",
        type=float,
        nargs="+",
        metavar="M",
        help="X Y X Y X Y ...: corners of an area, m in the map; its content is erased",
    )
    change.add_argument(
        "--wall",
        type=float,
        nargs="+",
        metavar="M",
        help="X Y X Y ...: a wall through these points, m in the map; no beam ever clears it",
    )
    change.add_argument(
        "--cut",
        nargs=2,
        metavar=("FROM", "TO"),
        help="take out the key frames of a time span: UTC (2026-11-22T10:15:00Z), or seconds after the first",
    )
    change.add_argument(
        "--add-pair",
        type=float,
        nargs=4,
        metavar=("X1", "Y1", "X2", "Y2"),
        help="two points of the map, m, that are one place; then optimise",
    )
    change.add_argument("--remove-pair", type=int, metavar="N", help="take a pair back; then optimise")
    change.add_argument(
        "--refuse-loop",
        type=int,
        nargs="+",
        metavar="N",
        help="take back accepted loops, by their numbers in map loops; then optimise",
    )
    change.add_argument("--optimize", action="store_true", help="solve the graph and render the map again")
    change.add_argument(
        "--undo", action="store_true", help="take the newest edit back; again: the one before it"
    )


def _add_edit(edit: argparse.ArgumentParser) -> None:
    edit.add_argument("map", type=local_path, metavar="MAP")
    _add_changes(edit.add_mutually_exclusive_group(required=True))
    becomes = edit.add_mutually_exclusive_group()
    becomes.add_argument("--free", action="store_true", help="with --erase: all of the area is free then")
    becomes.add_argument(
        "--unknown",
        action="store_true",
        help="with --erase: all of the area is unknown then (default: free where scans see through it)",
    )
    edit.add_argument(
        "--bridge", action="store_true", help="with --cut: odometry holds the two ends of what is cut"
    )
    edit.add_argument(
        "--keyframes",
        type=int,
        nargs=2,
        metavar=("K1", "K2"),
        help="with --add-pair: the key frames that saw the points (default: those that have them nearest)",
    )
    edit.add_argument("--to", type=int, metavar="VERSION", help="with --undo: go back to this version")
    edit.add_argument("--who", metavar="NAME", help="who makes the change (default: the user's name)")
