"""Where numba keeps machine code, whether it can, and what is there already."""

import ast
import sys
from pathlib import Path

from service.kernel_cache import KERNELS
from service.offline.doctor.findings import Finding, fault, note, ok
from service.offline.doctor.folders import cannot_write, nearest_parent
from service.offline.doctor.machine import Machine

KERNEL_DECORATORS = ("kernel", "inner_kernel")  # of service/kernels/compiled.py


def look_at_cache(machine: Machine) -> Finding:
    """Where numba keeps machine code, whether it can, and how many kernels are there already."""
    given = machine.environment.get("NUMBA_CACHE_DIR")
    home = machine.environment.get("XDG_CACHE_HOME") or str(
        Path(machine.environment.get("HOME", "/")) / ".cache"
    )
    places = [Path(given)] if given else [KERNELS / "__pycache__", Path(home) / "numba"]
    writable = [place for place in places if not cannot_write(nearest_parent(place))]
    if not writable:
        return fault(
            "cache",
            f"user {machine.user} cannot write {' or '.join(map(str, places))}: "
            "kernels are compiled at each start",
            "a folder for compiled kernels",
            "set NUMBA_CACHE_DIR to a folder that this user can write; "
            "the unit takes /var/cache/corridor/numba",
        )
    place = writable[0]
    missing, total = _cold_kernels(place)
    if missing:
        return note(
            "cache",
            f"{total - missing} of {total} kernels are compiled in {place}; "
            "the next start compiles the others, up to a minute",
            "corridor warmup",
        )
    return ok("cache", f"all {total} kernels are compiled in {place}", kernels=total)


def _cold_kernels(place: Path) -> tuple[int, int]:
    """Kernels without a fresh index file in the cache, and all; numba names one
    `module.function-line.py311.nbi`, in a folder of its own where NUMBA_CACHE_DIR is set."""
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    indices = {path.name: path.stat().st_mtime for path in place.glob("**/*.nbi")}
    missing = total = 0
    for source in sorted(KERNELS.glob("*.py")):
        for function, line in _cached_functions(source):
            total += 1
            name = f"{source.stem}.{function}-{line}.{python}.nbi"
            missing += indices.get(name, 0.0) < source.stat().st_mtime
    return missing, total


def _cached_functions(source: Path) -> list[tuple[str, int]]:
    """Name and first line, that of the decorator, of every kernel; and of what says `cache=True` itself."""
    found = []
    for node in ast.parse(source.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            words = [ast.unparse(decorator) for decorator in node.decorator_list]
            if any(word in KERNEL_DECORATORS or "cache=True" in word for word in words):
                found.append((node.name, min(d.lineno for d in node.decorator_list)))
    return found
