"""Li et al. 2016: sum against product in the rough search, and from how far off a scan is aligned."""

import math

import numpy as np

from service.estimator.motion import Prediction
from service.geometry.se2 import SE2
from service.kernels.likelihood_search import SearchWindow, search_exhaustive
from service.mapper.components import Match, Points
from service.mapper.filters.deskew import BeamsConfig
from service.mapper.papers.contour_lm.contour_map import ContourMap, ContourMapConfig
from service.mapper.papers.contour_lm.contour_matcher import ContourLm, ContourLmConfig, SearchConfig
from tests.papers.report import Row, Section, seeds_text
from tests.papers.true_poses import true_scans
from tests.simulated import Drive

SCANS = 100
LEAST = 0.1  # below it a logarithm is cut off
WINDOW = (5, 5, 5, 0.04)  # cells of the coarsest level, cells, steps, rad
BESIDE = np.array([0.3, 0.3, 0.1])  # m, m, rad: the middle of the window lies up to so far off
OFFSETS = ((0.1, 2.0), (0.2, 5.0), (0.3, 10.0), (0.45, 15.0))  # m, deg
BACK_M, BACK_RAD = 0.05, math.radians(0.5)


def starts(what: Drive, beams: BeamsConfig, seed: int) -> Section:
    """A7, A26, A42: a map learned at true poses, scans begun beside their places."""
    scans = list(true_scans(what, beams))
    pyramid, flat = (ContourMap(ContourMapConfig(levels=levels)) for levels in (3, 1))
    for points, match in scans:
        pyramid.insert(points, match)
        flat.insert(points, match)
    chosen = [scans[k] for k in np.linspace(0, len(scans) - 1, SCANS).astype(int)]
    noise = np.random.default_rng(1)
    rows = [Row("same place found by sum and by sum of logarithms", [same_place(chosen, pyramid)], "%", "A7")]
    for off_m, off_deg in OFFSETS:
        away = [
            SE2(
                off_m * math.cos(direction_rad),
                off_m * math.sin(direction_rad),
                float(noise.choice((-1, 1))) * math.radians(off_deg),
            )
            for direction_rad in noise.uniform(0.0, 2.0 * math.pi, SCANS)
        ]
        for name, sigmas, local_map in (
            ("search, then three levels", 2.0, pyramid),
            ("three levels alone", 0.0, pyramid),
            ("finest level alone", 0.0, flat),
        ):
            figure = f"back from {100 * off_m:.0f} cm and {off_deg:.0f}°: {name}"
            rows.append(Row(figure, [brought_back(chosen, away, local_map, sigmas)], "%", "A26 A42"))
    return Section(
        "Start poses from which the search converges",
        f"{SCANS} scans of the corridor with niches, on the map of them all at true poses. The "
        "search looks up to 50 cm and 20° around; back is within 5 cm and 0.5°. Logarithms are cut off at "
        "0.1.",
        rows,
        ran_on=seeds_text([seed]),
    )


def same_place(scans: list[tuple[Points, Match]], local_map: ContourMap) -> float:
    """% of scans for which sum and sum of logarithms are greatest at the same candidate."""
    layer = local_map.search_layer()
    logarithms = np.log(np.maximum(layer.cells, LEAST)).astype(np.float32)
    product = layer._replace(cells=logarithms, empty=math.log(LEAST))
    noise = np.random.default_rng(2)
    equal = 0
    for points, match in scans:
        pose = match.motion.pose_odom_base
        begin = np.array(pose) + noise.uniform(-1.0, 1.0, 3) * BESIDE
        window = SearchWindow(begin, *WINDOW)
        found = [search_exhaustive(points.xy_base, kind, window)[0].pose for kind in (layer, product)]
        equal += bool((found[0] == found[1]).all())
    return 100.0 * equal / len(scans)


def brought_back(
    scans: list[tuple[Points, Match]], away: list[SE2], local_map: ContourMap, window_sigmas: float
) -> float:
    """% of scans that the matcher aligns at the true pose, begun so far away."""
    matcher = ContourLm(ContourLmConfig(search=SearchConfig(window_sigmas=window_sigmas)))
    wide = np.diag([0.25, 0.25, 0.175]) ** 2
    back = 0
    for (points, match), off in zip(scans, away, strict=True):
        true = match.motion.pose_odom_base
        predicted = Prediction(
            pose_odom_base=true @ off,
            twist_base=match.motion.twist_base,
            covariance=wide,
            local_covariance=wide,
            elapsed_s=0.02,
            twist_covariance=np.zeros((3, 3)),
            travel_m=0.0,
            is_measured=False,
        )
        found = matcher.match(points, predicted, local_map)
        left = true.inverse() @ found.motion.pose_odom_base
        back += math.hypot(left.x_m, left.y_m) < BACK_M and abs(left.theta_rad) < BACK_RAD
    return 100.0 * back / len(scans)
