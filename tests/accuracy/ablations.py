"""What each part of the default profile is worth: the same drives with that part switched off."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any
from unittest.mock import patch

from simulators.worlds import WORLDS
from tests.accuracy.driving import Errors, Trip, default_with
from tests.papers.report import Section
from tests.simulated import LMS100_50HZ, Drive, run

# what is switched off, and by which keys, or by which constant; None: sweeps are declared instants
DYNAMIC_FILTER = "service.mapper.scan_match.dynamic_filter"
PARTS: tuple[tuple[str, dict[str, dict[str, Any]] | None], ...] = (
    ("nothing", {}),
    ("deskew", None),
    ("robust loss", {"matcher": {"cauchy_m": 1e3}}),
    (
        "learning of odometry's scale and lag",
        {"motion_model": {"odometry_scale_sigma": 0.0, "odometry_lag_sigma_s": 0.0}},
    ),
    ("surfels finer than 10 cm: 5 cm", {"local_map": {"cell_m": 0.05}}),
    ("dynamic-object filter", {"local_map": {"dynamic_filter": {"enough_s": 0.0}}}),
    ("weight by static score", {DYNAMIC_FILTER: {"MIN_NEW_WEIGHT": 1.0}}),
    ("ray-cast removal", {"local_map": {"dynamic_filter": {"behind_m": 1e3}}}),
    ("refusal of points in free space", {DYNAMIC_FILTER: {"FREE_S": 0.0}}),
    ("long sub-maps: 5 m", {"local_map": {"spacing_m": 5.0}}),
)


def ablations(seeds: Sequence[int]) -> Section:
    trips = {
        "ring": Trip(WORLDS["ring"], LMS100_50HZ),
        "office": Trip(WORLDS["office"], LMS100_50HZ),
        "spins": Trip(WORLDS["spins"], LMS100_50HZ, 30.0),
        "crowd": Trip(WORLDS["crowd"], LMS100_50HZ, 40.0),
        "ring, no odometry": Trip(WORLDS["ring"], replace(LMS100_50HZ, rate_hz=25.0), 40.0, wheels=None),
    }
    cells: dict[str, list[str]] = {what: [] for what, _ in PARTS}
    for trip in trips.values():
        drives = trip.drives(seeds)
        for what, settings in PARTS:
            cells[what].append(_cell(drives, settings))
    lines = ["| switched off | " + " | ".join(trips) + " |", "|---|" + "---|" * len(trips)]
    lines += [f"| {what} | " + " | ".join(row) + " |" for what, row in cells.items()]
    return Section(
        "Error without each part",
        "RMS error as is, mm, median (worst) of the seeds, with one part switched off. Parts without a "
        "switch in the config are not listed.",
        tables=["\n".join(lines)],
    )


def _cell(drives: list[Drive], settings: dict[str, dict[str, Any]] | None) -> str:
    keys = {box: values for box, values in (settings or {}).items() if "." not in box}
    errors = Errors()
    with ExitStack() as switched:
        for module, constants in (settings or {}).items():
            if module not in keys:
                switched.enter_context(patch.multiple(module, **constants))
        for drive in drives:
            errors.add(drive, run(default_with(**keys), drive, without_motion=settings is None))
    values = sorted(errors.as_is_mm)
    return f"{values[len(values) // 2]:.1f} ({values[-1]:.1f})"
