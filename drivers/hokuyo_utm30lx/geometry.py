"""Angles and times of a device's beams, from PP. No constants of a model."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import ProtocolError
from drivers.hokuyo_utm30lx.scans import ScanRequest

PP_LIMITS = {  # key: lowest and highest value; wider than any Hokuyo laser
    "DMIN": (0, 262_143),  # mm; three characters of six bits carry no more
    "DMAX": (0, 262_143),
    "ARES": (4, 100_000),
    "AMIN": (0, 9_999),  # four digits in a request
    "AMAX": (0, 9_999),
    "AFRT": (0, 9_999),
    "SCAN": (60, 12_000),  # rpm
}


@dataclass(frozen=True, slots=True)
class Geometry:
    """Steps count counter-clockwise seen from above."""

    distance_min_mm: int  # smaller values are error codes
    distance_max_mm: int
    steps_per_turn: int
    first_step: int
    last_step: int
    front_step: int
    speed_rpm: int

    @classmethod
    def of(cls, pairs: Mapping[str, str]) -> "Geometry":
        """From PP's lines. Raises ProtocolError where one is missing or invalid."""
        values = {key: _number(pairs, key) for key in PP_LIMITS}
        geometry = cls(*values.values())
        distances_in_order = geometry.distance_min_mm < geometry.distance_max_mm
        steps_in_order = geometry.first_step < geometry.last_step < geometry.first_step + values["ARES"]
        front_is_seen = geometry.first_step <= geometry.front_step <= geometry.last_step
        if not (distances_in_order and steps_in_order and front_is_seen):
            raise ProtocolError(
                f"PP: {values} describes no laser; expected DMIN < DMAX, AMIN < AMAX, AFRT between them, and "
                "AMAX less than ARES, a turn, behind AMIN"
            )
        return geometry

    @property
    def turn_ns(self) -> float:
        return 60e9 / self.speed_rpm

    @property
    def step_ns(self) -> float:
        return self.turn_ns / self.steps_per_turn

    @property
    def step_rad(self) -> float:
        return 2.0 * math.pi / self.steps_per_turn

    def step_at(self, angle_deg: float) -> int:
        """The step that looks nearest to an angle, within what can be seen."""
        step = self.front_step + round(angle_deg / 360.0 * self.steps_per_turn)
        return min(max(step, self.first_step), self.last_step)

    def angle_deg(self, step: int) -> float:
        return (step - self.front_step) * 360.0 / self.steps_per_turn

    def first_angle_rad(self, request: ScanRequest) -> float:
        """Angle of the first beam; that of several neighbours is their middle."""
        return (self.first_beam_step(request) - self.front_step) * self.step_rad

    def first_beam_step(self, request: ScanRequest) -> float:
        return request.first_step + (max(request.cluster, 1) - 1) / 2.0


def _number(pairs: Mapping[str, str], key: str) -> int:
    """Raises ProtocolError where it is missing, none, or one that no laser has."""
    lowest, highest = PP_LIMITS[key]
    text = pairs.get(key, "missing")
    try:
        value = int(text)
    except ValueError:
        value = None
    if value is None or not lowest <= value <= highest:
        raise ProtocolError(
            f"PP: {key} is {text[:20]}, expected {lowest} to {highest}; is it a Hokuyo laser?"
        ) from None
    return value
