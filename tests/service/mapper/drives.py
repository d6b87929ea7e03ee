"""Made-up drives with truth: walls, a motion, and what laser and wheels report of it.

Written apart from the simulators on purpose: an error in one of them cannot hide behind the other.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from drivers.frames import NO_INTENSITY, Frame, LaserScan, OdometrySample
from service.geometry.poses import compose
from service.geometry.se2 import SE2
from service.mapper.pipeline import Mapper
from service.mapper.profiles import build_mapper, mapping_config
from service.outputs import MapperOutput

ROOM = [  # an L-shaped room with a pillar: (x0, y0, x1, y1), m
    (-3.0, -2.0, 6.0, -2.0),
    (6.0, -2.0, 6.0, 2.5),
    (6.0, 2.5, 2.0, 2.5),
    (2.0, 2.5, 2.0, 5.0),
    (2.0, 5.0, -3.0, 5.0),
    (-3.0, 5.0, -3.0, -2.0),
    (-1.5, 2.0, -1.0, 2.0),
    (-1.0, 2.0, -1.0, 2.6),
    (-1.0, 2.6, -1.5, 2.6),
    (-1.5, 2.6, -1.5, 2.0),
]
CORRIDOR = [(-60.0, -1.0, 60.0, -1.0), (-60.0, 1.0, 60.0, 1.0)]
DOORS = CORRIDOR + [  # frames that stand 8 cm proud of the wall
    wall
    for k in range(-8, 12)
    for side in (-1.0, 1.0)
    for x in [3.1 * k + 0.4 * side + 0.3 * (k % 3)]
    for wall in (
        (x, side, x, 0.92 * side),
        (x, 0.92 * side, x + 0.9, 0.92 * side),
        (x + 0.9, 0.92 * side, x + 0.9, side),
    )
]

BEAMS, FIRST_RAD, STEP_RAD = 541, math.radians(-135.0), math.radians(0.5)
BEAM_NS, PERIOD_NS, ODOMETRY_NS = 27_778, 20_000_000, 15_000_000
MOUNTING = SE2(0.2, 0.05, 0.1)

Motion = Callable[[float], SE2]  # seconds -> base in the world


@dataclass(frozen=True)
class Drive:
    frames: list[Frame]
    truth: dict[int, SE2]  # scan stamp -> base in the frame of the first scan


def mapper_of(profile: str = "corridor", mounting: SE2 = MOUNTING, **section: object) -> Mapper:
    """section: further sections of the config."""
    return build_mapper(mapping_config({"profile": profile, **section}), {"front": mounting})


def outputs_of(mapper: Mapper, frames: Iterable[Frame]) -> list[MapperOutput]:
    return [output for frame in frames if (output := mapper.process(frame)) is not None]


def scans_of(frames: Iterable[Frame]) -> list[LaserScan]:
    return [frame for frame in frames if isinstance(frame, LaserScan)]


def errors(outputs: Iterable[MapperOutput], truth: dict[int, SE2]) -> np.ndarray:
    """(N, 3) forward m, left m, turn rad from the true pose."""
    return np.array([truth[o.stamp_ns].inverse() @ o.pose_map_base for o in outputs])


def cast(
    walls: list[tuple[float, float, float, float]], origins: np.ndarray, paths: np.ndarray
) -> np.ndarray:
    """Distance along each ray to the nearest wall, inf where there is none."""
    x0, y0, x1, y1 = (column[:, None] for column in np.array(walls).T)
    ex, ey = x1 - x0, y1 - y0
    to_x, to_y = x0 - origins[:, 0], y0 - origins[:, 1]
    denominator = paths[:, 0] * ey - paths[:, 1] * ex
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (to_x * ey - to_y * ex) / denominator
        share = (to_x * paths[:, 1] - to_y * paths[:, 0]) / denominator
    hit = (along > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.where(hit, along, np.inf).min(axis=0)


def poses_in_sweep(motion: Motion, begin_s: float) -> np.ndarray:
    """(BEAMS, 3) where the base is at the moment of each beam: a parabola through begin, middle and end, seen
    from the middle. What that leaves out of a motion in 15 ms is less than 0.1 mm.
    """
    sweep_s = (BEAMS - 1) * BEAM_NS * 1e-9
    begin, middle, end = (motion(begin_s + share * sweep_s) for share in (0.0, 0.5, 1.0))
    before, after = (np.array(middle.inverse() @ pose) for pose in (begin, end))
    u = np.linspace(-1.0, 1.0, BEAMS)[:, None]
    x, y, turn = (0.5 * u * (after - before) + 0.5 * u * u * (after + before)).T
    c, s = math.cos(middle.theta_rad), math.sin(middle.theta_rad)
    return np.column_stack((middle.x_m + c * x - s * y, middle.y_m + s * x + c * y, middle.theta_rad + turn))


def scan_at(
    walls: list[tuple[float, float, float, float]],
    motion: Motion,
    stamp_ns: int,
    start_ns: int,
    noise: np.random.Generator,
    sigma_m: float,
    mounting: SE2 = MOUNTING,
) -> LaserScan:
    """One sweep; every beam leaves from where the laser is at its own moment."""
    laser = compose(poses_in_sweep(motion, (stamp_ns - start_ns) * 1e-9), np.array(mounting))
    origins, angle = laser[:, :2], laser[:, 2] + FIRST_RAD + STEP_RAD * np.arange(BEAMS)
    paths = np.column_stack((np.cos(angle), np.sin(angle)))
    range_m = cast(walls, origins, paths) + sigma_m * noise.standard_normal(BEAMS)
    range_m[~(range_m < 20.0)] = np.nan
    return LaserScan(
        "front", stamp_ns, stamp_ns + BEAMS * BEAM_NS, BEAM_NS, PERIOD_NS, FIRST_RAD, STEP_RAD, 0.05, 20.0,
        range_m.astype(np.float32), NO_INTENSITY,
    )  # fmt: skip


def drive(
    walls: list[tuple[float, float, float, float]],
    motion: Motion,
    seconds: float,
    start_ns: int = 1_000_000_000,
    sigma_m: float = 0.01,
    wheel_scale: float | None = 1.01,
    mounting: SE2 = MOUNTING,
    every: int = 1,
    seed: int = 1,
) -> Drive:
    """Scans at 50 Hz and odometry at 67 Hz, by arrival.

    wheel_scale: what the wheels make of a metre; None where there are none.
    every: so many turns of the laser make one scan; the others are left out.
    """
    noise = np.random.default_rng(seed)
    frames: list[Frame] = []
    truth = {}
    if wheel_scale is not None:
        pose = SE2()
        for k in range(int(seconds * 1e9) // ODOMETRY_NS + 1):
            before = motion(max(k - 1, 0) * ODOMETRY_NS * 1e-9)
            forward, left, turn = (before.inverse() @ motion(k * ODOMETRY_NS * 1e-9)).log()
            pose = pose @ SE2.exp(wheel_scale * forward, wheel_scale * left, turn)
            stamp_ns = start_ns + k * ODOMETRY_NS
            arrived_ns, twist, covariance = stamp_ns + 2_000_000, (0.0, 0.0, 0.0), (0.0,) * 9
            frames.append(OdometrySample("base", stamp_ns, arrived_ns, *pose, twist, covariance))
    for k in range(0, int(seconds * 1e9) // PERIOD_NS, every):
        stamp_ns = start_ns + k * PERIOD_NS + 1_234_567
        frames.append(scan_at(walls, motion, stamp_ns, start_ns, noise, sigma_m, mounting))
        truth[stamp_ns] = motion((stamp_ns - start_ns) * 1e-9)
    first = next(iter(truth.values())).inverse()
    frames.sort(key=lambda frame: frame.arrived_ns)
    return Drive(frames, {stamp_ns: first @ pose for stamp_ns, pose in truth.items()})


def eased(time_s: float) -> float:
    """Time that is constant for 0.4 s and then takes a second to reach full speed."""
    since_s = max(time_s - 0.4, 0.0)
    return since_s**2 / 2.0 if since_s < 1.0 else since_s - 0.5


def round_the_room(time_s: float) -> SE2:
    """From rest along an ellipse with changing speed, heading along it."""
    time_s = eased(time_s)
    phase = 0.5 * time_s + 0.2 * math.sin(time_s)
    x, y = 1.0 + 1.5 * math.cos(phase), 0.4 + 0.8 * math.sin(phase)
    return SE2(x, y, math.atan2(0.8 * math.cos(phase), -1.5 * math.sin(phase)))


def down_the_corridor(time_s: float) -> SE2:
    return SE2(eased(time_s), 0.1, 0.02)


def standing(time_s: float) -> SE2:
    return SE2(0.5, 0.3, 0.4)
