"""Drives of one simulated site: parts of a lap through an office floor, from several starts, both ways."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from service.offline.score.trajectory import write_tum
from simulators.trajectory import THETA, TURN_RATE, WAY
from simulators.world import World
from simulators.worlds.floor import floor
from simulators.worlds.office import office
from tests.recorded_drive import record
from tests.service.recording.sessions import T0_NS
from tests.simulated import FORWARD, LMS100_50HZ, Wheels, begun_beside, drive, phase_m

SEEDS = range(11, 23)
ELSEWHERE = (21, 22)  # of another building
SECONDS, APART_S = 130.0, 23.0  # of each drive, and between their starts along the lap
HOUR_NS = 3600 * 10**9
LASER = replace(LMS100_50HZ, rate_hz=25.0)


def record_drive(seed: int, folder: Path) -> tuple[Path, Path]:
    """site_SEED.mcap, and beside it the true poses in the frame of the world as a TUM file."""
    world = office() if seed in ELSEWHERE else floor()
    world = begun_beside(backwards(world) if seed % 2 == 0 else world, *phase_m(seed))
    made = drive(world, LASER, SECONDS, seed, Wheels(), stand_s=-(seed - SEEDS[0]) * APART_S)
    begin_ns = T0_NS + seed * HOUR_NS
    session = record(made.frames, {"front": FORWARD}, folder / "in" / str(seed), begin_ns)
    session = session.rename(folder / f"site_{seed}.mcap")
    truth = folder / f"site_{seed}.tum"
    poses = ((stamp_ns + begin_ns, made.world_first @ pose) for stamp_ns, pose in sorted(made.truth.items()))
    write_tum(truth, poses)
    return session, truth


def backwards(world: World) -> World:
    """The same lap, driven from its end to its begin."""
    nodes = world.drive.nodes[::-1].copy()
    nodes[:, WAY] = nodes[0, WAY] - nodes[:, WAY]
    nodes[:, THETA] += np.pi
    nodes[:, TURN_RATE] *= -1.0
    return replace(world, drive=replace(world.drive, nodes=nodes))
