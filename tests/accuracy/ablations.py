"""What each part and rule of the default profile is worth: the same drives without it."""

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any
from unittest.mock import Mock, patch

from service.kernels.deskew import deskew_points
from service.kernels.filter_state import PackedFilter, views_of
from service.kernels.normals import estimate_normals
from service.kernels.tracks import Track
from service.mapper.filters.deskew import DeskewByTwist
from service.mapper.graph.model.loops import agree
from service.mapper.graph.model.point_clouds import SurfelSet
from service.mapper.profiles import mapping_config
from service.mapper.scan_match.narrow_walls import Matrix
from service.mapper.scan_match.submaps import Submap
from simulators.worlds import WORLDS
from tests.accuracy.driving import Errors, Trip
from tests.accuracy.sensors import GOOD_WHEELS, LMS100_10HZ, LUX_AHEAD, MIRRORS, WRONG
from tests.papers.report import Section
from tests.simulated import LMS100_50HZ, Imu, run

ESTIMATOR, STANDSTILL = "service.estimator.estimator", "service.estimator.standstill.Standstill"
MATCH, DESKEW = "service.mapper.scan_match", "service.mapper.filters.deskew"
GAUSS_NEWTON = f"{MATCH}.surfel_gauss_newton"
MODEL, LOOPS = "service.mapper.graph.model", "service.mapper.graph.loops"
CLOUD = f"{MODEL}.point_clouds.SurfelSet"
UNKNOWN_MOTION = Mock(pose_at=lambda stamp_ns: None)  # in place of a SteadyMotion


def unmoved(*arguments: Any) -> None:
    """As estimate_normals, whose first argument is the points, and the last one those moved."""
    estimate_normals(*arguments)
    arguments[-1][:] = arguments[0]


def deskewed_by_twist(
    packed: PackedFilter, _odometry: Track, _gyro: Track, _settings: Any, *arrays: Matrix
) -> None:
    """In place of deskew_sweep."""
    beam_time_s, xy_raw, xy_base = arrays
    deskew_points(xy_raw, beam_time_s, views_of(packed).twist, xy_base)


def as_aligned(matcher: Any, aligned: Any, attempt: Any) -> Any:
    return aligned


def agree_without_growth(keyframes: Any, a: Any, b: Any, base: Any, growth: Any) -> Any:
    return agree(keyframes, a, b, base, (0.0, 0.0))


AS_GIVEN = dict.fromkeys(("directed", "insert"), lambda walls, points, normals, pose: normals)
NO_MOVING_SCENE = {"match": lambda *_: None, "judge": as_aligned, "explain": lambda *_: None}
# What is switched off; the component whose settings do it (no dot), or the module or class whose values are
# replaced; and these. No place: sweeps are declared instants.
PARTS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("nothing", "matcher", {}),
    ("deskew", "", {}),
    ("robust loss", "matcher", {"cauchy_m": 1e3}),
    ("odometry's scale learnt", "motion_model", {"odometry_scale_sigma": 0.0}),
    ("odometry's lag learnt", "motion_model", {"odometry_lag_sigma_s": 0.0}),
    ("surfels finer than 10 cm: 5 cm", "local_map", {"cell_m": 0.05}),
    ("dynamic-object filter", "local_map", {"dynamic_filter": {"enough_s": 0.0}}),
    ("weight by static score", f"{MATCH}.dynamic_filter", {"MIN_NEW_WEIGHT": 1.0}),
    ("ray-cast removal", "local_map", {"dynamic_filter": {"behind_m": 1e3}}),
    ("refusal of points in free space", f"{MATCH}.dynamic_filter", {"FREE_S": 0.0}),
    ("long sub-maps: 5 m", "local_map", {"spacing_m": 5.0}),
    ("less what chance gives, of a scan ([22])", GAUSS_NEWTON, {"_chance_chi2": lambda _: 0.0}),
    ("motion within a sweep ([23])", ESTIMATOR, {"deskew_sweep": deskewed_by_twist}),
    ("acceleration that lasts", ESTIMATOR, {"ACCELERATION_S": 1e-4}),  # of the same density: white
    ("pose at the middle of a sweep", f"{DESKEW}.DeskewByMotion", {"moment_of": DeskewByTwist.moment_of}),
    ("odometry with a fault does not count", ESTIMATOR, {"FAULT_NOISE": math.inf}),
    ("coarse start held to the prediction", GAUSS_NEWTON, {"COARSE_M": 0.0, "COARSE_RAD": 0.0}),
    ("match where it would be had it gone on", GAUSS_NEWTON, {"SteadyMotion": lambda: UNKNOWN_MOTION}),
    ("missing returns are no gaps beside posts", f"{MATCH}.posts", {"may_be_posts": lambda *_: (True, 0)}),
    ("points moved along their walls ([24])", "service.mapper.walls", {"estimate_normals": unmoved}),
    ("walls by several key frames ([27])", f"{MATCH}.narrow_walls.NarrowWalls", AS_GIVEN),
    ("surfels of half the size ([32])", f"{MATCH}.submaps.Submap", {"fine_grid": Submap.grid}),
    ("held near the prediction ([33])", f"{GAUSS_NEWTON}.SurfelGaussNewton", {"_more_likely": as_aligned}),
    ("part of the scene moves ([35])", f"{MATCH}.moving_scene.MovingScene", NO_MOVING_SCENE),
    ("odometry that stands ([30])", STANDSTILL, {"is_uninformative": lambda *_: False}),
    ("bias of the ranges ([21])", f"{MATCH}.range_bias.RangeBias", {"is_due": lambda *_: False}),
    ("several loops, over 5 m of path", "graph", {"consensus_span_m": 1e-9}),
    ("one loop where the path leads to it", f"{MODEL}.path_drift", {"CHI2_99_OF_3": -1.0}),
    ("limit of drift", f"{MODEL}.path_drift", {"MAX_DRIFT_CHI2": math.inf}),
    ("variance of poor steps", f"{MODEL}.odometry_edges", {"MAX_PREDICTION_VARIANCE": (0.0, 0.0)}),
    ("errors shared in a cell", CLOUD, {"align_with_shared_errors": SurfelSet.align}),
    ("less what chance gives, of a loop ([22])", f"{MODEL}.candidate_submap", {"CHANCE_CHI2": 0.0}),
    ("open directions as expected", f"{MODEL}.candidate_submap", {"MAX_MOVES": 0}),
    ("unknown ground neutral", f"{MODEL}.candidate_submap", {"LOOP_UNKNOWN_LIKELIHOOD": 0.0}),
    ("points in free space count", f"{LOOPS}.loop_search", {"MAX_AGAINST": 2.0}),
    ("least inlier ratio of a loop", f"{LOOPS}.loop_search", {"MIN_SHARE_ON_MAP": 0.0}),
    ("contradicted loops disabled", f"{LOOPS}.loop_set", {"CONTRADICTION_CHI2": math.inf}),
    ("tolerance that grows with the path", f"{LOOPS}.loop_set", {"agree": agree_without_growth}),
    ("more passes than the nearest", f"{LOOPS}.loop_search", {"PASSES": 1}),
    ("wide search at the finish", f"{LOOPS}.loop_back_end", {"FINISH_WINDOW": (0.01, 0.01)}),
)
TRIPS = {
    "ring": Trip(WORLDS["ring"], LMS100_50HZ),
    "office": Trip(WORLDS["office"], LMS100_50HZ),
    "spins": Trip(WORLDS["spins"], LMS100_50HZ, 30.0),
    "crowd": Trip(WORLDS["crowd"], LMS100_50HZ, 40.0),
    "ring, no odometry": Trip(WORLDS["ring"], replace(LMS100_50HZ, rate_hz=25.0), 40.0, wheels=None),
    "corridor100": Trip(WORLDS["corridor100"], LMS100_50HZ),
    "corridor100, LUX": Trip(WORLDS["corridor100"], LUX_AHEAD, wheels=GOOD_WHEELS, imu=Imu()),
    "bare corridor": Trip(WORLDS["featureless"], LMS100_50HZ, 100.0),
    "office, 30 % of the beams lost": Trip(
        WORLDS["office"], replace(LMS100_50HZ, model=replace(LMS100_50HZ.model, dropout_share=0.3))
    ),
    "office, ranges too long by 30 mm": Trip(
        WORLDS["office"], replace(LMS100_50HZ, model=replace(LMS100_50HZ.model, bias_m=0.03))
    ),
    "office, mirror of 5 Hz": Trip(WORLDS["office"], MIRRORS["5 Hz"]),
    "office, 10 Hz, odometry dead": Trip(WORLDS["office"], LMS100_10HZ, change=WRONG["dead"]),
}


def ablations(seeds: Sequence[int]) -> Section:
    lines = ["| switched off | " + " | ".join(TRIPS) + " |", "|---|" + "---|" * len(TRIPS)]
    for what, place, values in PARTS:
        cells = [_cell(trip, seeds, place, values) for trip in TRIPS.values()]
        lines.append(f"| {what} | " + " | ".join(cells) + " |")
    return Section(
        "Error without each part and rule",
        "RMS error as is, then after the finish, mm, median (worst) of the seeds, with one part or rule "
        "switched off. Numbers in brackets are those of estimator.md.",
        tables=["\n".join(lines)],
    )


def _cell(trip: Trip, seeds: Sequence[int], place: str, values: dict[str, Any]) -> str:
    errors = Errors()
    with patch.multiple(place, **values) if "." in place else nullcontext():
        for made in trip.drives(seeds):
            config = mapping_config({"settings": {} if "." in place or not place else {place: values}})
            errors.add(made, run(config, made, without_motion=not place))
    return ", ".join(_median_and_worst(of) for of in (errors.as_is_mm, errors.finished_mm))


def _median_and_worst(values_mm: Sequence[float]) -> str:
    ordered = sorted(values_mm)
    return f"{ordered[len(ordered) // 2]:.1f} ({ordered[-1]:.1f})"
