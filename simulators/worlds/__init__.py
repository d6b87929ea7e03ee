"""Worlds by name. A new one is a module with a function that returns a World, and a line here."""

from collections.abc import Callable

from simulators.world import World
from simulators.worlds.corridors import corridor100, ring
from simulators.worlds.floor import floor
from simulators.worlds.library import library
from simulators.worlds.mall import mall
from simulators.worlds.navis import glass_corridor, hall, t_room
from simulators.worlds.office import office
from simulators.worlds.trials import crowd, featureless, glass_hall, room, spins, stop_and_go

WORLDS: dict[str, Callable[[], World]] = {
    "office": office,
    "ring": ring,
    "corridor100": corridor100,
    "floor": floor,
    "mall": mall,
    "room": room,
    "featureless": featureless,
    "spins": spins,
    "stop_and_go": stop_and_go,
    "crowd": crowd,
    "glass_hall": glass_hall,
    "library": library,
    "t_room": t_room,
    "glass_corridor": glass_corridor,
    "hall100": lambda: hall(100.0),
    "hall200": lambda: hall(200.0),
    "hall300": lambda: hall(300.0),
}


def build_world(name: str) -> World:
    """Raises ValueError for an unknown name."""
    try:
        return WORLDS[name]()
    except KeyError:
        raise ValueError(f"no world {name!r}; there are {', '.join(sorted(WORLDS))}") from None
