"""One scan aligned with a known map, against the Cramer-Rao bound of that very scene."""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from service.geometry.se2 import SE2
from service.mapper.scan_match.submaps import SubmapsConfig, SurfelSubmaps
from service.mapper.scan_match.surfel_gauss_newton import SurfelGaussNewton, SurfelMatcherConfig
from simulators.world import World
from simulators.worlds import build_world
from tests.papers.report import Row, Section
from tests.service.mapper.scan_match.standing_scans import cast, hardly_known, insert_at, points_from
from tests.simulated import LMS100_50HZ, UTM30LX_40HZ, Laser

MAP_SCANS, SCANS = 300, 150
STEP_M, STEP_RAD = 1e-4, 1e-5  # of the differences that give the derivatives
START_OFF_M, START_OFF_RAD = 0.03, 0.01


def known_map(seeds: Sequence[int]) -> Section:
    rows = []
    scenes = (
        ("square room of 10 m, centre", "room", 0.0),
        ("ring corridor, in the middle of a side", "ring", 12.0),
        ("office", "office", 12.0),
    )
    for scene, world_name, at_s in scenes:
        world = build_world(world_name)
        for name, laser in (("LMS-100, 541 beams", LMS100_50HZ), ("UTM-30LX, 1081", UTM30LX_40HZ)):
            where = world.drive.poses(np.array([at_s]))[0]
            pose = SE2(float(where[0]), float(where[1]), float(where[2]))
            bound = np.sqrt(np.diag(np.linalg.inv(fisher_information(world, laser, pose))))
            ratios, spreads = [], []
            for seed in seeds:
                errors = match_errors(world, laser, pose, seed)
                rms = np.sqrt((errors**2).mean(axis=0))
                ratios.append(float(np.max(rms / bound)))
                spreads.append(1e3 * float(np.hypot(rms[0], rms[1])))
            rows += [
                Row(f"{scene}, {name}: worst axis / bound", ratios, "times", at_most=1.5),
                Row(
                    f"the same: position (bound {1e3 * math.hypot(bound[0], bound[1]):.2f} mm, "
                    f"{math.degrees(bound[2]):.4f} deg)",
                    spreads,
                    "mm",
                    digits=2,
                ),
            ]
    return Section(
        "One scan against a known map",
        f"{SCANS} scans from one place. Each is matched to a map of {MAP_SCANS} scans that were inserted at "
        f"their true poses around that place; the start is off by {100 * START_OFF_M:.0f} cm and "
        f"{START_OFF_RAD} rad, and the prior has no weight. The bound is the Cramer-Rao bound of the ranges "
        "(Censi 2007); its derivatives are taken by casting the scene from poses beside the true one, "
        "without mixed pixels. The figure is the RMS error over the bound, of the worst axis.",
        rows,
    )


def fisher_information(world: World, laser: Laser, pose: SE2) -> npt.NDArray[np.float64]:
    """(3, 3) of x, y, theta in base axes at `pose`, from all beams that return.

    Source: Censi, On achievable accuracy for range-finder localization, ICRA 2007: the sum over the beams of
    the outer product of the range's derivatives, over the variance of the range.
    """
    deltas = ((STEP_M, 0.0, 0.0), (0.0, STEP_M, 0.0), (0.0, 0.0, STEP_RAD))
    range_m, hit = cast(world, laser, pose)
    derivatives = np.zeros((3, laser.beams))
    usable = np.isfinite(range_m)
    for k, delta in enumerate(deltas):
        ahead_m, ahead_hit = cast(world, laser, pose @ SE2(*delta))
        behind_m, behind_hit = cast(world, laser, pose @ SE2(*delta).inverse())
        usable &= (ahead_hit == hit) & (behind_hit == hit)
        with np.errstate(invalid="ignore"):
            derivatives[k] = (ahead_m - behind_m) / (2.0 * sum(delta))
    sigma_m = laser.model.sigma_m + laser.model.sigma_per_m * range_m[usable]
    j = derivatives[:, usable] / sigma_m
    information: npt.NDArray[np.float64] = j @ j.T
    return information


def match_errors(world: World, laser: Laser, pose: SE2, seed: int) -> npt.NDArray[np.float64]:
    """(SCANS, 3) errors in base axes of scans from `pose`, each on the same known map."""
    noise = np.random.default_rng(seed)
    local_map = SurfelSubmaps(SubmapsConfig())
    matcher = SurfelGaussNewton(SurfelMatcherConfig())
    for _ in range(MAP_SCANS):
        along_m, aside_m, turn_rad = noise.standard_normal(3) * (0.3, 0.05, 0.2)
        beside = pose @ SE2(float(along_m), float(aside_m), float(turn_rad))
        insert_at(local_map, points_from(world, laser, beside, noise), beside)
    errors = np.empty((SCANS, 3))
    for k in range(SCANS):
        off_m, off_rad = START_OFF_M * noise.standard_normal(2), START_OFF_RAD * noise.standard_normal()
        start = pose @ SE2(float(off_m[0]), float(off_m[1]), float(off_rad))
        points = points_from(world, laser, pose, noise)
        found = matcher.match(points, hardly_known(start), local_map).motion.pose_odom_base
        away = pose.inverse() @ found
        errors[k] = away.x_m, away.y_m, away.theta_rad
    return errors
