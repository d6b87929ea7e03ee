"""Simulated drives by the default profile, and its errors."""

import gc
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from service.geometry.poses import compose
from service.geometry.se2 import SE2
from service.mapper.corrections import corrected
from service.mapper.profiles import MappingConfig, mapping_config
from service.offline.score.score import align
from service.outputs import MapperOutput
from simulators.world import World
from tests.papers.report import Row
from tests.simulated import Drive, Imu, Laser, Run, Wheels, begun_at, drive, heading_rad, run

Change = Callable[[Drive], Drive]
WHEELS = Wheels()  # 1 cm and 0.3 deg per root metre, at 67 Hz


@dataclass(frozen=True)
class Trip:
    """A drive through a world with a vehicle's sensors."""

    world: Callable[[], World]
    laser: Laser
    seconds: float | None = None  # None: one lap
    wheels: Wheels | None = field(default_factory=lambda: WHEELS)
    imu: Imu | None = None
    change: Change | None = None  # of the frames

    def drives(self, seeds: Sequence[int]) -> list[Drive]:
        """Once for each seed, each begun at a heading of its own against the walls."""
        return [self._drive(seed) for seed in seeds]

    def world_of(self, seed: int) -> World:
        """With this seed's drive."""
        return begun_at(self.world(), heading_rad(seed))

    def _drive(self, seed: int) -> Drive:
        world = self.world_of(seed)
        longer_s = world.drive.duration_s - self.world().drive.duration_s
        seconds = world.drive.duration_s if self.seconds is None else self.seconds + longer_s
        made = drive(world, self.laser, seconds, seed, self.wheels, self.imu)
        return made if self.change is None else self.change(made)

    def runs(self, seeds: Sequence[int], config: MappingConfig | None = None) -> Iterator[tuple[Drive, Run]]:
        """One after the other, so that memory holds the maps of one."""
        for seed in seeds:
            made = self._drive(seed)
            yield made, run(config or mapping_config(), made)
            gc.collect()


def default_with(**settings: dict[str, Any]) -> MappingConfig:
    """The default profile with other values of some keys, by box."""
    return mapping_config({"settings": settings})


def poses_of(poses: Sequence[SE2]) -> npt.NDArray[np.float64]:
    return np.array([(pose.x_m, pose.y_m, pose.theta_rad) for pose in poses])


def ate_m(made: Drive, done: Run, poses: Sequence[SE2]) -> float:
    """RMS distance of a pose for each output of a run, after the best rigid motion."""
    estimate = poses_of(poses)
    truth = poses_of([made.truth[output.stamp_ns] for output in done.outputs])
    off = compose(align(estimate, truth), estimate) - truth
    return float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()))


def nees_of(outputs: Sequence[MapperOutput], errors: npt.NDArray[np.float64]) -> float:
    """Mean over every tenth live pose; without the first tenth, where error and covariance are nearly 0.

    errors: (N, 3) of each, against the first scan
    """
    tenth = range(len(outputs) // 10, len(outputs), 10)
    return float(np.mean([errors[k] @ np.linalg.solve(outputs[k].covariance, errors[k]) for k in tenth]))


def lost_share(done: Run) -> float:
    return float(np.mean([output.state == "lost" for output in done.outputs]))


def ok_and_wrong(done: Run) -> float:
    """Scans that are `ok` and more than 0.3 m and 3 sigma off."""
    off_m = np.hypot(done.errors[:, 0], done.errors[:, 1])
    covariance = np.array([output.covariance for output in done.outputs])
    sigma_m = np.sqrt(np.linalg.eigvalsh(covariance[:, :2, :2])[:, 1])
    is_ok = np.array([output.state == "ok" for output in done.outputs])
    return float(np.sum(is_ok & (off_m > 0.3) & (off_m > 3.0 * sigma_m)))


def ok_and_wrong_row(what: str, scans: list[float]) -> Row:
    """Of what ok_and_wrong gives for each seed: none may be."""
    return Row(f"{what}: scans `ok`, 0.3 m and 3 sigma off", scans, "scans", at_most=0.0, by_worst=True)


@dataclass
class Errors:
    """Of the runs of one trip, a value a seed."""

    ate_mm: list[float] = field(default_factory=list)  # live
    finished_mm: list[float] = field(default_factory=list)  # ATE after the finish
    as_is_mm: list[float] = field(default_factory=list)
    heading_deg: list[float] = field(default_factory=list)
    end_mm: list[float] = field(default_factory=list)
    end_deg: list[float] = field(default_factory=list)
    lost_percent: list[float] = field(default_factory=list)
    scan_ms: list[float] = field(default_factory=list)  # p50
    wrong_ok: list[float] = field(default_factory=list)  # scans, see ok_and_wrong

    def add(self, made: Drive, done: Run) -> None:
        end_m, end_rad = done.end_error
        self.ate_mm.append(1e3 * ate_m(made, done, [output.pose_map_base for output in done.outputs]))
        finished = corrected(done.outputs, done.mapper.finish().corrections)
        self.finished_mm.append(1e3 * ate_m(made, done, finished))
        self.as_is_mm.append(1e3 * done.position_rmse_m)
        self.heading_deg.append(math.degrees(done.heading_rmse_rad))
        self.end_mm.append(1e3 * end_m)
        self.end_deg.append(math.degrees(end_rad))
        self.lost_percent.append(100.0 * lost_share(done))
        self.scan_ms.append(float(np.median(done.scan_ms)))
        self.wrong_ok.append(ok_and_wrong(done))


def errors_of(trip: Trip, seeds: Sequence[int], config: MappingConfig | None = None) -> Errors:
    errors = Errors()
    for made, done in trip.runs(seeds, config):
        errors.add(made, done)
    return errors
