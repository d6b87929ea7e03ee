"""For methods without a graph: map and odom are one frame."""

from service.geometry.se2 import SE2
from service.mapper.stages import MapChange


class NoGraph:
    def add(self, change: MapChange) -> SE2:
        return SE2()
