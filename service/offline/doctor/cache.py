"""Where numba keeps machine code, whether it can, and what is there already."""

from drivers.counted import counted
from service.compile.cache import cache_folder, cache_places, is_warm
from service.offline.doctor.findings import Finding, fault, note, ok
from service.offline.doctor.folders import cannot_write, nearest_parent
from service.offline.doctor.machine import Machine


def look_at_cache(machine: Machine) -> Finding:
    """Finding on numba's cache: its folder, whether it is writable, and the number of compiled kernels."""
    places = cache_places(machine.environment)
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
    kernels = sum(1 for _ in cache_folder(place).glob("*.nbi"))
    if not is_warm(place):
        return note(
            "cache",
            f"{counted(kernels, 'kernel')} compiled in {place}, not those of all profiles; "
            "a start compiles what it lacks, up to a minute",
            "corridor warmup",
        )
    return ok("cache", f"the kernels of all profiles are compiled in {place}", kernels=kernels)
