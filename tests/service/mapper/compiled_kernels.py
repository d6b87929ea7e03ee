"""Warm up, map a drive, print as JSON how many kernels numba compiled, and how many signatures each has.

In a process of its own, because other tests call kernels in their own ways.
"""

import importlib
import json
import pkgutil

from numba.core import event

import service.kernels
from service.kernel_cache import ensure_cache_dir
from service.kernel_warm_up import warm_up
from service.mapper.profiles import build_mapper, mapping_config
from tests.service.mapper.drives import MOUNTING, ROOM, drive, round_the_room

FOREIGN_KERNELS = ("raycast",)  # those of the simulators


def main() -> None:
    ensure_cache_dir()
    with event.install_recorder("numba:compile") as compiled:
        warm_up()
        mapper = build_mapper(mapping_config(), {"front": MOUNTING})
        for frame in drive(ROOM, round_the_room, 2.0).frames:
            mapper.process(frame)
        mapper.changed_tiles()
    counts = {}
    for module in pkgutil.iter_modules(service.kernels.__path__):
        if module.name in FOREIGN_KERNELS:
            continue
        for name, kernel in vars(importlib.import_module(f"service.kernels.{module.name}")).items():
            if hasattr(kernel, "signatures") and kernel.py_func.__module__.endswith(module.name):
                counts[f"{module.name}.{name}"] = len(kernel.signatures)
    print(json.dumps({"compiled": len(compiled.buffer), "signatures": counts}))


if __name__ == "__main__":
    main()
