"""Warm up and map a drive twice, and print as JSON how many kernels numba compiled and what was loaded late.

First as the live service: the graph's back end runs in another process, and a map that it rendered replaces
the shown one; with the argument `localizing` scans are also compared with it. Then with all profiles and all
in this process. In a process of its own, because other tests call kernels with other types.
"""

import importlib
import json
import pickle
import pkgutil
import sys

import numpy as np
from numba.core import event

import service.kernels
from service.compile.cache import ensure_cache_dir
from service.compile.warm_up import warm_up
from service.geometry.se2 import SE2
from service.mapper.background import InlineWorker, NewWorker
from service.mapper.components import RenderedMap, ScanToRender, WallToRender
from service.mapper.map_changes import ChangeWatch
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.profiles import MappingConfig, build_mapper, import_methods, mapping_config
from tests.service.mapper.discarding_worker import DiscardingWorker
from tests.service.mapper.drives import MOUNTING, ROOM, drive, round_the_room
from tests.service.mapper.maps.points import points_of

FOREIGN_KERNELS = ("raycast",)  # those of the simulators


def main() -> None:
    ensure_cache_dir()
    is_localizing = sys.argv[1:] == ["localizing"]
    with event.install_recorder("numba:compile") as compiled:
        config = mapping_config({"mode": "localization"} if is_localizing else {})
        warm_up(back_end_elsewhere=True)
        before = set(compiled_or_loaded())
        map_room(DiscardingWorker, config)
        replace_shown(is_localizing)
        live = {
            "late": sorted(set(compiled_or_loaded()) - before),
            "imported": [name for name in ("gtsam", "scipy.linalg") if name in sys.modules],
            "solver": signatures().get("loops.align_surfels", 0),
        }
        import_methods()
        warm_up()
        map_room(InlineWorker, mapping_config())
    print(json.dumps(live | {"compiled": len(compiled.buffer), "signatures": signatures()}))


def map_room(new_worker: NewWorker, config: MappingConfig) -> None:
    mapper = build_mapper(config, {"front": MOUNTING}, new_worker=new_worker)
    for frame in drive(ROOM, round_the_room, 2.0).frames:
        mapper.process(frame)
    mapper.changed_tiles()


def signatures() -> dict[str, int]:
    """How many each kernel has of which code is loaded."""
    counts = {}
    for module in pkgutil.iter_modules(service.kernels.__path__):
        if module.name in FOREIGN_KERNELS:
            continue
        for name, kernel in vars(importlib.import_module(f"service.kernels.{module.name}")).items():
            if hasattr(kernel, "signatures") and kernel.py_func.__module__.endswith(module.name):
                counts[f"{module.name}.{name}"] = len(kernel.signatures)
    return counts


def replace_shown(is_localizing: bool) -> None:
    """What a mapper does when the graph has been solved, or it begins in a stored map; that stays as it is
    where the vehicle is only localised.
    """
    xy = np.array([[2.0, y] for y in np.linspace(-2.0, 2.0, 100)])
    wall = WallToRender(np.array([[9.0, 0.0], [9.0, 3.0]]))
    shown = OccupancyTiles(OccupancyConfig(), 0.05)
    scans = [] if is_localizing else [ScanToRender(xy.astype(np.float32), (0.0, 0.0), SE2())]
    made = shown.renderer.render([*scans, wall])
    rendered: RenderedMap = pickle.loads(pickle.dumps(made))
    shown.replace_by(rendered, scans)
    points = points_of(xy)
    if is_localizing:
        ChangeWatch(rendered, 0.05).add(points, SE2(), 0)
    else:
        shown.insert(points, SE2())
    shown.changed_tiles()


def compiled_or_loaded() -> list[str]:
    """Kernels that have machine code in this process, and for which types."""
    return [
        f"{kernel.py_func.__module__}.{kernel.__name__}{types}"
        for name, module in list(sys.modules.items())
        if name.startswith("service.kernels.")
        for kernel in vars(module).values()
        for types in getattr(kernel, "overloads", ())
    ]


if __name__ == "__main__":
    main()
