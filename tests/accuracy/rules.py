"""Error of the default profile without single rules, on simulated drives and given recordings."""

import math
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from service.kernels.deskew import deskew_points
from service.kernels.filter_state import FilterRecord
from service.kernels.normals import estimate_normals
from service.kernels.range_bias import walls_of_scan
from service.kernels.tracks import Track
from service.mapper.components import Points
from service.mapper.filters.deskew import DeskewByTwist
from service.mapper.scan_match.narrow_walls import Matrix, NarrowWalls
from service.mapper.scan_match.submaps import Submap
from simulators.worlds import WORLDS
from tests.accuracy.driving import Errors, Trip, default_with
from tests.accuracy.given import error_mm, recording_of
from tests.accuracy.recorded import mapped
from tests.accuracy.sensors import LMS100_10HZ, MIRRORS, WRONG
from tests.papers.report import Section
from tests.shared_data import SHARED
from tests.simulated import LMS100_50HZ

METHOD = "service.mapper.scan_match"
DYNAMIC_FILTER = f"{METHOD}.submaps"


def normals_of_points_as_they_are(*arguments: Any) -> None:
    """As estimate_normals, whose first argument is the points, and the last one those moved."""
    estimate_normals(*arguments)
    arguments[-1][:] = arguments[0]


def walls_of_points_as_they_are(*arguments: Any) -> bool:
    """As walls_of_scan, which writes the points and those moved to the last argument but one."""
    has_posts: bool = walls_of_scan(*arguments)
    arguments[-2][2:] = arguments[-2][:2]
    return has_posts


def deskewed_by_twist(record: FilterRecord, _odometry: Track, _gyro: Track, *arrays: Matrix) -> None:
    """In place of deskew_sweep."""
    beam_time_s, xy_raw, xy_base = arrays
    deskew_points(xy_raw, beam_time_s, record["twist"][0], xy_base)


def not_deskewed(_record: FilterRecord, _odometry: Track, _gyro: Track, *arrays: Matrix) -> None:
    """In place of deskew_sweep."""
    _, xy_raw, xy_base = arrays
    xy_base[:] = xy_raw


def by_single_scans(walls: NarrowWalls, points: Points, normals: Matrix, pose: Matrix) -> Matrix:
    """In place of NarrowWalls.insert."""
    return normals


# what is switched off, where, and the value that does it
RULES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("nothing", METHOD, {}),
    (
        "information of a scan reduced by what chance gives ([22])",
        f"{METHOD}.surfel_gauss_newton",
        {"_chance_chi2": lambda _: 0.0},
    ),
    (
        "unknown ground neutral in the loop search",
        "service.mapper.graph.model.candidate_submap",
        {"LOOP_UNKNOWN_LIKELIHOOD": 0.0},
    ),
    ("motion within a sweep ([23])", "service.estimator.estimator", {"deskew_sweep": deskewed_by_twist}),
    (
        "acceleration that lasts",
        "service.estimator.estimator",
        {"ACCELERATION_S": 1e-4},  # of the same density: white
    ),
    (
        "pose at the middle of a sweep",
        "service.mapper.filters.deskew.DeskewByMotion",
        {"moment_of": DeskewByTwist.moment_of},
    ),
    ("odometry with a fault does not count", "service.estimator.estimator", {"FAULT_NOISE": math.inf}),
    (
        "match tried where the vehicle would be had it gone on",
        f"{METHOD}.surfel_gauss_newton.SurfelGaussNewton",
        {"_matched_at_constant_velocity": lambda _, aligned, attempt: aligned},
    ),
    (
        "points moved along their walls ([24])",
        "service.mapper",
        {
            "walls.estimate_normals": normals_of_points_as_they_are,
            "scan_match.posts.walls_of_scan": walls_of_points_as_they_are,
        },
    ),
    (
        "directions of walls by several key frames ([27])",
        f"{METHOD}.narrow_walls.NarrowWalls",
        {"direct": lambda *_: None, "insert": by_single_scans},
    ),
    ("aligned by surfels of half the size ([32])", f"{METHOD}.submaps.Submap", {"fine_grid": Submap.grid}),
    (
        "part of the scene moves where odometry and static walls agree ([35])",
        f"{METHOD}.moving_scene.MovingScene",
        {"match": lambda *_: None, "judge": lambda _, aligned, attempt: aligned, "explain": lambda *_: None},
    ),
    (
        "walls alone decide where small objects pull a match ([38])",
        f"{METHOD}.small_objects.SmallObjects",
        {"without": lambda _, aligned, attempt: aligned},
    ),
    (
        "odometry that stands counts only where a vehicle can stand ([30])",
        "service.estimator.standstill.Standstill",
        {"is_uninformative": lambda *_: False},
    ),
    (
        "what odometry reports late is driven ([30])",
        "service.estimator.standstill.Standstill",
        {"hidden_motion": lambda *_: None},
    ),
    (
        "wheels that jump in speed slip ([39])",
        "service.estimator.wheel_slip.WheelSlip",
        {"step": lambda *_: None},
    ),
    (
        "odometry may be wrong where the map contradicts a scan near its prediction ([37])",
        f"{METHOD}.surfel_gauss_newton.SurfelGaussNewton",
        {"_matched_by_inertia": lambda _, aligned, attempt: aligned},
    ),
    ("deskew", "service.estimator.estimator", {"deskew_sweep": not_deskewed}),
    ("weight by static score", DYNAMIC_FILTER, {"MIN_NEW_WEIGHT": 1.0}),
    ("refusal of points in free space", DYNAMIC_FILTER, {"FREE_S": 0.0}),
    ("bias of the ranges learnt ([21])", f"{METHOD}.range_bias.RangeBias", {"is_due": lambda *_: False}),
)
# what is switched off, and the settings that do it
SETTINGS: tuple[tuple[str, dict[str, dict[str, Any]]], ...] = (
    ("robust loss", {"matcher": {"cauchy_m": 1e3}}),
    (
        "learning of odometry's scale and lag",
        {"motion_model": {"odometry_scale_sigma": 0.0, "odometry_lag_sigma_s": 0.0}},
    ),
    ("dynamic-object filter", {"local_map": {"dynamic_filter": {"enough_s": 0.0}}}),
    ("ray-cast removal", {"local_map": {"dynamic_filter": {"behind_m": 1e3}}}),
)
TRIPS = {
    "corridor100": Trip(WORLDS["corridor100"], LMS100_50HZ),
    "bare corridor, at its end": Trip(WORLDS["featureless"], LMS100_50HZ, 100.0),
    "ring": Trip(WORLDS["ring"], LMS100_50HZ),
    "ring, no odometry": Trip(WORLDS["ring"], replace(LMS100_50HZ, rate_hz=25.0), 40.0, wheels=None),
    "office": Trip(WORLDS["office"], LMS100_50HZ),
    "spins": Trip(WORLDS["spins"], LMS100_50HZ, 30.0),
    "crowd": Trip(WORLDS["crowd"], LMS100_50HZ, 40.0),
    "office, 30 % of the beams lost": Trip(
        WORLDS["office"], replace(LMS100_50HZ, model=replace(LMS100_50HZ.model, dropout_share=0.3))
    ),
    "office, ranges too long by 30 mm": Trip(
        WORLDS["office"], replace(LMS100_50HZ, model=replace(LMS100_50HZ.model, bias_m=0.03))
    ),
    "office, mirror of 5 Hz": Trip(WORLDS["office"], MIRRORS["5 Hz"]),
    "office, 10 Hz, odometry dead": Trip(WORLDS["office"], LMS100_10HZ, change=WRONG["dead"]),
    "library, 10 Hz, odometry dead after 20 s": Trip(
        WORLDS["library"], LMS100_10HZ, change=WRONG["dead after 20 s"]
    ),
}
SYNTHETIC = ("corridor100d_s1", "fgi_s1", "ring_s3")
REAL = ("fr079", "intel", "csail", "aces")


@dataclass(frozen=True)
class Rule:
    """Is in force unless `off` or `settings` say otherwise."""

    module: str = ""
    off: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def _switched(self) -> ExitStack:
        switches = ExitStack()
        for name, value in self.off.items():
            switches.enter_context(patch(f"{self.module}.{name}", value))
        return switches

    def trip_mm(self, trip: Trip, seeds: Sequence[int], is_end: bool) -> str:
        errors = Errors()
        with self._switched:
            for made, done in trip.runs(seeds, default_with(**self.settings)):
                errors.add(made, done)
        values = sorted(errors.end_mm if is_end else errors.finished_mm)
        return f"{values[len(values) // 2]:.1f} ({values[-1]:.1f})"

    def recording_mm(self, name: str) -> str:
        with tempfile.TemporaryDirectory() as out, self._switched:
            mapped(recording_of(name), Path(out), self.settings)
            return f"{error_mm(name, Path(out) / 'trajectory.tum'):.1f}"


def rules(seeds: Sequence[int]) -> Section:
    kinds = [(what, Rule(module, off)) for what, module, off in RULES]
    kinds += [(what, Rule(settings=settings)) for what, settings in SETTINGS]
    lines = ["| drive | " + " | ".join(what for what, _ in kinds) + " |", "|---|" + "---|" * len(kinds)]
    for name, trip in TRIPS.items():
        cells = [rule.trip_mm(trip, seeds, "end" in name) for _, rule in kinds]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    if (SHARED / "worlds").exists():
        for name in SYNTHETIC + REAL:
            cells = [rule.recording_mm(name) for _, rule in kinds]
            lines.append(f"| `{name}` | " + " | ".join(cells) + " |")
    return Section(
        "Error without single rules",
        "Error after the finish in mm with one rule switched off, median (worst) of the seeds. Given "
        "recordings have one run each: RMS against the truth, or the mean of the relations for real ones. "
        "In the bare corridor the figure is the error at the end.",
        tables=["\n".join(lines)],
    )
