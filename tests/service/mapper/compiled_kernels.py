"""Warm up, map a drive, print as JSON how many kernels numba compiled, and how many signatures each has.

With the argument `live` as the live service: the graph's back end runs in another process, and a map that it
rendered replaces the shown one; with `localizing` scans are also compared with it.

In a process of its own, because other tests call kernels with other types.
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
from service.mapper.background import DiscardingWorker, InlineWorker, NewWorker
from service.mapper.components import RenderedMap, ScanToRender, WallToRender
from service.mapper.map_changes import ChangeWatch
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.profiles import build_mapper, import_methods, mapping_config
from tests.service.mapper.drives import MOUNTING, ROOM, drive, round_the_room
from tests.service.mapper.maps.points import points_of

FOREIGN_KERNELS = ("raycast",)  # those of the simulators


def main() -> None:
    ensure_cache_dir()
    with event.install_recorder("numba:compile") as compiled:
        new_worker: NewWorker = InlineWorker
        config = mapping_config()
        if sys.argv[1:]:
            new_worker = DiscardingWorker
            config = mapping_config({"mode": "localization"} if sys.argv[1] == "localizing" else {})
            warm_up(back_end_elsewhere=True)
            before = set(compiled_or_loaded())
        else:
            import_methods()
            warm_up()
        mapper = build_mapper(config, {"front": MOUNTING}, new_worker=new_worker)
        for frame in drive(ROOM, round_the_room, 2.0).frames:
            mapper.process(frame)
        mapper.changed_tiles()
        if sys.argv[1:]:
            replace_shown(is_localizing=sys.argv[1] == "localizing")
    counts = {}
    for module in pkgutil.iter_modules(service.kernels.__path__):
        if module.name in FOREIGN_KERNELS:
            continue
        for name, kernel in vars(importlib.import_module(f"service.kernels.{module.name}")).items():
            if hasattr(kernel, "signatures") and kernel.py_func.__module__.endswith(module.name):
                counts[f"{module.name}.{name}"] = len(kernel.signatures)
    heavy = [name for name in ("gtsam", "scipy.linalg") if name in sys.modules]
    late = sorted(set(compiled_or_loaded()) - before) if sys.argv[1:] else []
    facts = {"compiled": len(compiled.buffer), "signatures": counts, "imported": heavy, "late": late}
    print(json.dumps(facts))


def replace_shown(is_localizing: bool) -> None:
    """What a mapper does when the graph has been solved, or it begins in a stored map; that stays as it is
    where the vehicle is only localised.
    """
    xy = np.array([[2.0, y] for y in np.linspace(-2.0, 2.0, 100)])
    wall = WallToRender(np.array([[9.0, 0.0], [9.0, 3.0]]))
    shown = OccupancyTiles(OccupancyConfig(), 0.05)
    scans = [] if is_localizing else [ScanToRender(xy.astype(np.float32), (0.0, 0.0), SE2())]
    drawn = shown.renderer.render([*scans, wall])
    rendered: RenderedMap = pickle.loads(pickle.dumps(drawn))
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
