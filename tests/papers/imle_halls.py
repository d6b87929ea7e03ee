"""A child process: map a large hall, drive through it, time and memory as JSON. Arguments: SIZE SEED."""

import json
import sys
import time
from dataclasses import replace

import numpy as np

from drivers.frames import NO_INTENSITY, LaserScan
from service.compile.warm_up import warm_up
from service.estimator.motion import Motion
from service.geometry.se2 import SE2
from service.mapper.components import Match, Points
from service.mapper.papers.imle.patch_map import PatchMap, PatchMapConfig
from service.mapper.pipeline import Mapper
from service.mapper.profiles import build_mapper, mapping_config
from service.mapstore.patch_files import PatchFiles
from simulators.truth import UTM30LX
from simulators.world import World
from simulators.worlds import build_world
from tests.processes import resident_mb
from tests.simulated import Laser, drive

MODEL = replace(UTM30LX, range_max_m=20.0)
LASER = Laser(MODEL, 541, 5.0, -135.0, 0.5, SE2())
SECONDS = 48.0
MAPPED_EVERY_M = 10.0


def known_scan(world: World, x_m: float, y_m: float) -> Points:
    """The noise-free scan of 360 deg at a place."""
    angle = np.radians(np.arange(-180.0, 180.0, 0.5))
    rays = np.stack([np.full(720, x_m), np.full(720, y_m), angle, np.zeros(720)], axis=1)
    range_m, _ = world.cast(np.ascontiguousarray(rays), world.discs(0.0, 1.0), 20.0)
    seen = np.isfinite(range_m)
    xy = range_m[seen, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)[seen]
    scan = LaserScan(
        "front", 0, 0, 0, 1, -np.pi, np.radians(0.5), 0.0, 20.0, range_m.astype(np.float32), NO_INTENSITY
    )
    return Points(xy, xy, np.zeros(len(xy)), np.flatnonzero(seen).astype(np.int32), SE2(), scan)


def map_all(world: World, patches: PatchMap, half_m: float) -> None:
    """From known poses, row by row, begun at the far end so that the start is in memory last."""
    places = np.arange(-half_m + 3.0, half_m - 2.0, MAPPED_EVERY_M)
    order = sorted(
        ((float(x), float(y)) for x in places for y in places), key=lambda at: -max(abs(at[0]), abs(at[1]))
    )
    for x_m, y_m in order:
        points = known_scan(world, x_m, y_m)
        motion = Motion(SE2(x_m, y_m, 0.0), (0.0, 0.0, 0.0), np.eye(3))
        patches.insert(points, Match(motion, points, 1.0))


def main(size: int, seed: int) -> None:
    mapping_config({"profile": "imle"})  # imports what calls kernels
    warm_up()
    world = build_world(f"hall{size}")
    what = drive(world, LASER, SECONDS, seed)
    stores: list[PatchFiles] = []

    def new_store() -> PatchFiles:
        stores.append(PatchFiles())
        return stores[-1]

    mapper: Mapper = build_mapper(
        mapping_config({"profile": "imle"}), {"front": SE2()}, new_patch_store=new_store
    )
    patches: PatchMap = mapper.components.local_map
    before_mb = resident_mb()
    map_all(world, patches, size / 2)
    took_ms, fetched, largest_mb = [], [], resident_mb()
    known = set(patches.resident)
    for frame in what.frames:
        began_s = time.thread_time()
        mapper.process(frame)
        took_ms.append((time.thread_time() - began_s) * 1e3)
        fetched.append(bool(set(patches.resident) - known))
        known = set(patches.resident)
        largest_mb = max(largest_mb, resident_mb())
    took = np.array(took_ms[2:])
    crossed = took[np.array(fetched[2:])]
    config: PatchMapConfig = patches.config
    patch_bytes = config.patch_cells**2 + (config.patch_cells // config.coarse_cells) ** 2
    saved = len(stores[0]._saved)
    print(
        json.dumps(
            {
                "median_ms": float(np.median(took)),
                "longest_ms": float(took.max()),
                "crossing_ms": float(crossed.max()) if len(crossed) else float(np.median(took)),
                "crossings": len(crossed),
                "grown_mb": largest_mb - before_mb,
                "map_mb": len(set(stores[0]._saved) | set(patches.resident)) * patch_bytes / 1e6,
                "bytes_per_cm2": stores[0].disk_bytes / (saved * (config.patch_m * 100.0) ** 2)
                if saved
                else 1.04,
            }
        )
    )


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
