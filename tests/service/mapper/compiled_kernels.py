"""Warm up, map a drive, print as JSON how many kernels numba compiled, and how many signatures each has.

With the argument `live` as the live service does: the graph's back end works elsewhere.

In a process of its own, because other tests call kernels in their own ways.
"""

import importlib
import json
import pkgutil
import sys

from numba.core import event

import service.kernels
from service.kernel_cache import ensure_cache_dir
from service.kernel_warm_up import warm_up
from service.mapper.background import ElsewhereWorker, InlineWorker, NewWorker
from service.mapper.profiles import build_mapper, mapping_config
from tests.service.mapper.drives import MOUNTING, ROOM, drive, round_the_room

FOREIGN_KERNELS = ("raycast",)  # those of the simulators


def main() -> None:
    ensure_cache_dir()
    with event.install_recorder("numba:compile") as compiled:
        new_worker: NewWorker = InlineWorker
        if sys.argv[1:] == ["live"]:
            new_worker = ElsewhereWorker
            warm_up(mapping_config(), back_end_elsewhere=True)
            before = set(compiled_or_loaded())
        else:
            warm_up()
        mapper = build_mapper(mapping_config(), {"front": MOUNTING}, new_worker=new_worker)
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
    heavy = [name for name in ("gtsam", "scipy.linalg") if name in sys.modules]
    late = sorted(set(compiled_or_loaded()) - before) if sys.argv[1:] == ["live"] else []
    told = {"compiled": len(compiled.buffer), "signatures": counts, "imported": heavy, "late": late}
    print(json.dumps(told))


def compiled_or_loaded() -> list[str]:
    """Kernels that have machine code in this process."""
    return [
        f"{kernel.py_func.__module__}.{kernel.__name__}"
        for name, module in list(sys.modules.items())
        if name.startswith("service.kernels.")
        for kernel in vars(module).values()
        if getattr(kernel, "overloads", None)
    ]


if __name__ == "__main__":
    main()
