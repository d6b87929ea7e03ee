"""A Rao-Blackwellised particle filter: every particle is aligned with its own map.

Sample, weigh, resample, as in Zhang et al. 2016, section 1.2; the maps are those of CountedSubmaps. The step
of a particle is sampled from the motion model and then aligned with its map, because without odometry the
sample alone would miss it. Its weight is then not p / q of eq. 2, as the q of a moved sample is unknown;
`draw: around_scan` has a q and that weight.
"""

from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from service.estimator.motion import Measurement, Prediction
from service.geometry import poses as se2
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.counted_occupancy import weigh_scan
from service.kernels.likelihood_lm import thin_evenly
from service.kernels.likelihood_search import search_exhaustive
from service.kernels.particles import normalise_weights, resample
from service.kernels.pose_information import rotate_information
from service.mapper.components import Match, Points
from service.mapper.judgement import MIN_AGREEMENT_FAR, JudgementConfig
from service.mapper.matchers.covariances import diagonal, in_base_axes, inverse
from service.mapper.matchers.field_align import align, information_at, values_at
from service.mapper.matchers.judged import Aligned, JudgedMatching
from service.mapper.matchers.window_search import layer_of, search_around, step_of, thinned, window_around
from service.mapper.papers.submap_graph.counted_submaps import CountedSubmaps, Particle

Array = npt.NDArray[np.float64]
SEARCH_STEP_RAD = 0.02  # rotates a point at 5 m by two cells


class ParticleFilterConfig(JudgementConfig):
    """How particles are sampled, aligned with their maps and weighed."""

    seed: int = Field(default=1, ge=0)
    # aligned: from the motion model, then aligned with the map, weighed by the likelihood of the scan
    # around_scan: around the aligned pose, weighed by p / q (eq. 2)
    draw: Literal["aligned", "around_scan"] = "aligned"
    align_sigma: float = Field(default=0.5, gt=0.0)  # of 1 - likelihood, against the motion model
    align_beams: int = Field(default=180, ge=10)
    align_iterations: int = Field(default=8, ge=0, le=100)
    likelihood_floor: float = Field(default=0.05, gt=0.0, lt=1.0)
    likelihood_gain: float = Field(default=0.1, gt=0.0, le=1.0)  # beams are not independent
    # inliers over returns on known ground; below it the map is searched
    least_agreement: float = Field(default=MIN_AGREEMENT_FAR, ge=0.0, le=1.0)
    search_m: float = Field(default=0.5, gt=0.0)  # to each side
    search_rad: float = Field(default=0.35, gt=0.0)
    resample_below: float = Field(default=0.5, ge=0.0, le=1.0)  # effective share of the particles
    floor_position_m: float = Field(default=0.006, gt=0.0)
    floor_heading_rad: float = Field(default=0.0015, gt=0.0)


class ParticleFilter:
    """Matcher[CountedSubmaps]. Random numbers come from a counter-based generator with a seed."""

    def __init__(self, config: ParticleFilterConfig) -> None:
        self._config = config
        self._matching = JudgedMatching(config)
        self._random = np.random.Generator(np.random.Philox(key=config.seed))
        self._floor = diagonal(config.floor_position_m, config.floor_heading_rad)
        self._last = SE2()  # pose by the motion model at the previous scan
        self._deviates: Array = np.zeros((0, 3))  # of the scan being aligned, a row a particle

    def match(self, points: Points, predicted: Prediction, local_map: CountedSubmaps) -> Match:
        """The match; a lost scan neither weighs the particles nor moves them."""
        log_weights = local_map.log_weights.copy()
        match = self._matching.match(points, predicted, local_map, self)
        if match.measured is None:
            local_map.gather(predicted.pose_odom_base)
            local_map.log_weights[:] = log_weights
            normalise_weights(local_map.log_weights, local_map.weights)
        else:
            self._resample(local_map)
        self._last = match.motion.pose_odom_base
        return match

    compare = match  # its state is independent of the laser

    def align(
        self, points: Points, predicted: Prediction, local_map: CountedSubmaps, is_found: bool = False
    ) -> Aligned:
        """Fuse prediction and scan: particles are sampled from the former and weighed by the latter."""
        if is_found:
            local_map.gather(predicted.pose_odom_base)
            local_map.log_weights[:] = 0.0
            step = SE2()
        else:
            step = self._last.between(predicted.pose_odom_base)
        self.move_particles(step, predicted.local_covariance, local_map)
        self._align_or_search(points, predicted, local_map)
        normalise_weights(local_map.log_weights, local_map.weights)
        return Aligned(self._mean(local_map), points)

    def search(
        self, points: Points, local_map: CountedSubmaps, pose: SE2, reach: tuple[float, float]
    ) -> SE2 | None:
        layer = layer_of(local_map.best.map.likelihood())
        return search_around(points.xy_base, pose, reach, layer, step_of(reach))

    def _resample(self, local_map: CountedSubmaps) -> None:
        count = len(local_map.particles)
        if 1.0 / float(np.square(local_map.weights).sum()) >= self._config.resample_below * count:
            return
        chosen = np.empty(count, np.int64)
        resample(local_map.weights, float(self._random.random()), chosen)
        local_map.take_over(chosen)

    def move_particles(self, step: SE2, covariance: Array, local_map: CountedSubmaps) -> None:
        """Move each particle by a step, and by a sampled error if particles are sampled from the motion."""
        vector = np.array(step)
        self._deviates = self._random.standard_normal((len(local_map.particles), 3))
        root = _root(covariance) if self._config.draw == "aligned" else np.zeros((3, 3))
        for particle, error in zip(local_map.particles, self._deviates @ root.T, strict=True):
            particle.pose = se2.compose(se2.compose(particle.pose, vector), error)

    def _align_or_search(self, points: Points, predicted: Prediction, local_map: CountedSubmaps) -> None:
        """Align each particle with its map.

        Where returns lie in free space of the best particle's map, odometry may be wrong: that map is then
        searched, all particles are moved alike and aligned again. A scan with few inliers alone, as on new
        ground, is not searched for: in a corridor whose far walls are isolated points a search finds the
        previous pose.
        """
        weights = local_map.log_weights.copy()
        likelihood, best = self.align_particles(points, predicted, local_map)
        searched = local_map.particles[best]
        if local_map.overlap_of(searched, points.xy_base).agreement >= self._config.least_agreement:
            return
        aligned = local_map.log_weights.copy(), [particle.pose for particle in local_map.particles]
        moved = self._search(points, searched)
        for particle in local_map.particles:
            particle.pose = se2.compose(particle.pose, moved)
        local_map.log_weights[:] = weights
        found, _ = self.align_particles(points, predicted, local_map)
        if found <= likelihood:
            local_map.log_weights[:] = aligned[0]
            for particle, pose in zip(local_map.particles, aligned[1], strict=True):
                particle.pose = pose

    def _search(self, points: Points, particle: Particle) -> Array:
        """Offset (3,) of the best fit from a particle's pose, in its own axes."""
        config = self._config
        layer = layer_of(particle.map.likelihood())
        window = window_around(particle.pose, (config.search_m, config.search_rad), layer, SEARCH_STEP_RAD)
        found, _ = search_exhaustive(thinned(points.xy_base, config.align_beams), layer, window)
        return se2.between(particle.pose, found.pose)

    def align_particles(
        self, points: Points, predicted: Prediction, local_map: CountedSubmaps
    ) -> tuple[float, int]:
        """Align each particle with its map and weigh it; returns the best mean likelihood and its index."""
        information = inverse(predicted.local_covariance + 1e-12 * np.eye(3))
        means = np.empty(len(local_map.particles))
        thin = thin_evenly(points.xy_base, self._config.align_beams, self._config.align_sigma)
        for k, particle in enumerate(local_map.particles):
            log_weight, means[k] = self._align_one(thin, particle, information, self._deviates[k])
            local_map.log_weights[k] += log_weight
        best = int(np.argmax(means))
        return float(means[best]), best

    def _align_one(
        self, thin: tuple[Array, Array], particle: Particle, information: Array, deviates: Array
    ) -> tuple[float, float]:
        """Align a particle with its map, or sample it around the aligned pose.

        thin          points (M, 2) and weights (M,) of thin_evenly
        information   (3, 3) of the motion, base axes
        Returns the logarithm of the factor on its weight, up to a constant, and the mean likelihood.
        Source of p / q: Grisetti, Stachniss, Burgard 2007, section III.
        """
        config, field = self._config, particle.map.likelihood()
        start, prior = particle.pose, np.empty((3, 3))
        rotate_information(information, float(start[2]), prior)
        pose = align(*thin, (start, prior), field, start, config.align_iterations)
        pose[2] = wrap_angle(float(pose[2]))
        log_p_over_q = 0.0
        if config.draw == "around_scan":
            proposal = np.linalg.inv(information_at(*thin, pose, field) + prior)
            pose += np.linalg.cholesky(proposal) @ deviates
            pose[2] = wrap_angle(float(pose[2]))
            off = pose - start
            off[2] = wrap_angle(float(off[2]))
            log_p_over_q = 0.5 * float(deviates @ deviates - off @ prior @ off)
            log_p_over_q += 0.5 * float(np.linalg.slogdet(proposal)[1])
        particle.pose = pose
        log_likelihood, mean = weigh_scan(values_at(thin[0], pose, field), config.likelihood_floor)
        return config.likelihood_gain * log_likelihood + log_p_over_q, float(mean)

    def _mean(self, local_map: CountedSubmaps) -> Measurement:
        poses = np.array([particle.pose for particle in local_map.particles])
        weights = local_map.weights
        best = poses[int(np.argmax(weights))]
        apart = poses - best
        apart[:, 2] = wrap_angle(apart[:, 2])
        offset = weights @ apart
        x_m, y_m, theta_rad = (best + offset).tolist()
        pose = SE2(x_m, y_m, wrap_angle(theta_rad))
        spread = np.einsum("k,ki,kj->ij", weights, apart - offset, apart - offset)
        covariance = in_base_axes(spread, theta_rad) + self._floor
        return Measurement(pose, covariance, inverse(covariance))


def _root(covariance: Array) -> Array:
    """A square root of a covariance, which may be singular."""
    values, axes = np.linalg.eigh(covariance)
    root: Array = axes * np.sqrt(np.maximum(values, 0.0))
    return root
