"""Single scans of a vehicle that stands in a simulated world, and a map made of them at true poses."""

import math

import numpy as np
import numpy.typing as npt

from drivers.frames import NO_INTENSITY, LaserScan
from service.estimator.motion import Motion, Prediction
from service.geometry.se2 import SE2
from service.mapper.components import Match, Points
from service.mapper.filters.deskew import BeamsConfig, DeskewByTwist
from service.mapper.scan_match.submaps import SurfelSubmaps
from simulators.world import World
from tests.simulated import Laser

PRIOR_SIGMA_M, PRIOR_SIGMA_RAD = 0.3, 0.1  # so weak that the scan alone decides
STILL = (0.0, 0.0, 0.0)


def hardly_known(pose: SE2) -> Prediction:
    """Of a vehicle that stands near this pose: the scan decides."""
    prior = _motion(pose, PRIOR_SIGMA_M, PRIOR_SIGMA_RAD)
    return Prediction(
        pose_odom_base=pose,
        twist_base=STILL,
        covariance=prior.covariance,
        local_covariance=prior.covariance,
        twist_covariance=np.zeros((3, 3)),
        elapsed_s=1.0,
        travel_m=1.0,
        is_measured=False,
    )


def insert_at(local_map: SurfelSubmaps, points: Points, pose: SE2) -> None:
    """Put a scan into a map at its true pose."""
    local_map.insert(points, Match(_motion(pose, 1e-6, 1e-6), points, 1.0, submap=0))


def _motion(pose: SE2, sigma_m: float, sigma_rad: float) -> Motion:
    return Motion(pose, STILL, np.diag([sigma_m**2, sigma_m**2, sigma_rad**2]))


def points_from(world: World, laser: Laser, pose: SE2, noise: np.random.Generator) -> Points:
    """A scan from `pose`, the vehicle standing, with the noise of the laser and nothing else."""
    range_m, _ = cast(world, laser, pose)
    range_m = np.where(np.isfinite(range_m), range_m, np.nan)
    model = laser.model
    range_m = range_m + (model.sigma_m + model.sigma_per_m * range_m) * noise.standard_normal(laser.beams)
    scan = LaserScan(
        sensor=laser.name,
        stamp_ns=0,
        arrived_ns=0,
        beam_interval_ns=0,
        scan_period_ns=laser.period_ns,
        first_angle_rad=math.radians(laser.first_deg),
        angle_step_rad=math.radians(laser.step_deg),
        range_min_m=model.range_min_m,
        range_max_m=model.range_max_m,
        range_m=range_m.astype(np.float32),
        intensity=NO_INTENSITY,
    )
    return DeskewByTwist(BeamsConfig(), {laser.name: laser.mounting})(scan, _motion(pose, 1.0, 1.0))


def cast(world: World, laser: Laser, pose: SE2) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
    """As World.cast, of the beams of a laser whose vehicle stands at `pose`."""
    sensor = pose @ laser.mounting
    rays = np.zeros((laser.beams, 4))
    rays[:, 0], rays[:, 1] = sensor.x_m, sensor.y_m
    steps = np.arange(laser.beams) * laser.step_deg
    rays[:, 2] = sensor.theta_rad + np.radians(laser.first_deg + steps)
    return world.cast(rays, np.empty((0, 5)), laser.model.range_max_m)
