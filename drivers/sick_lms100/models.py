"""The SICK scanners that share the LMS1xx's telegram, a row each, and those that do not. No I/O.

Sources: LMS500 manual 8013796, 10.2 (rates and steps, field of view); SICKAG/sick_scan_xd,
sick_generic_parser.cpp (echoes, straight ahead at 90 deg) and its issues 70 and 192; recordings of an LMS111,
an LMS511, a TiM551 and a TiM781S.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

ModelName = Literal["lms1xx", "lms5xx", "tim5xx", "tim7xx"]


@dataclass(frozen=True, slots=True)
class Model:
    """Abilities of a family. Angles are the device's own, 900_000 is straight ahead."""

    name: str
    rates_hz: tuple[int, ...]  # the first is the default, as of the steps
    steps_deg: tuple[float, ...]
    max_shots_hz: int  # of rate and step together
    range_max_m: float  # default of the setting
    echoes: Literal["channels", "filter", "one"]  # chosen by LMDscandatacfg, by FREchoFilter, or there is one
    first_e4deg: int = -450_000
    last_e4deg: int = 2_250_000
    output_range_first: bool = False  # LMPoutputRange must be applied (Run) before mLMPsetscancfg
    output_step_e4deg: int | None = None  # what LMPoutputRange states as its step; None: the step there is

    @property
    def scan_is_fixed(self) -> bool:
        """Whether rate and step are the device's own, and cannot be written."""
        return len(self.rates_hz) == 1

    def has_time_for(self, rate_hz: int, step_deg: float) -> bool:
        """Whether it can measure so finely at this rate; steps are rounded, so 0.1 % more counts as equal."""
        return rate_hz * 360.0 / step_deg <= 1.001 * self.max_shots_hz

    @property
    def max_beams(self) -> int:
        """At the finest step, and one that some firmware adds."""
        return round((self.last_e4deg - self.first_e4deg) / (min(self.steps_deg) * 1e4)) + 2

    @property
    def field_of_view_deg(self) -> tuple[float, float]:
        """Field of view as in the config: 0 straight ahead, left positive."""
        return self.first_e4deg / 1e4 - 90.0, self.last_e4deg / 1e4 - 90.0

    @property
    def defaults(self) -> dict[str, Any]:
        """Defaults of the settings that depend on the model."""
        first_deg, last_deg = self.field_of_view_deg
        return {
            "scan_rate_hz": self.rates_hz[0],
            "angle_step_deg": self.steps_deg[0],
            "first_angle_deg": first_deg,
            "last_angle_deg": last_deg,
            "range_max_m": self.range_max_m,
        }


LMS1XX = Model(
    "LMS1xx", (50, 25), (0.5, 0.25), 36_000, range_max_m=20.0, echoes="channels", output_step_e4deg=5000
)
TIM7XX = Model("TiM7xx", (15,), (0.3333,), 16_200, range_max_m=25.0, echoes="one")
MODELS: Mapping[str, Model] = {
    "lms1xx": LMS1XX,
    "lms5xx": Model(
        name="LMS5xx",
        rates_hz=(50, 25, 35, 75, 100),
        steps_deg=(0.5, 0.1667, 0.25, 0.3333, 0.6667, 0.75, 1.0),
        max_shots_hz=54_000,
        range_max_m=65.0,  # 80 m with the scale of 2 that SOPAS ET can set
        echoes="filter",
        first_e4deg=-50_000,
        last_e4deg=1_850_000,
        output_range_first=True,
    ),
    "tim5xx": replace(TIM7XX, name="TiM5xx", steps_deg=(0.3333, 1.0)),  # TiM561 and TiM571; TiM551
    "tim7xx": TIM7XX,
}

# How DeviceIdent begins, in capitals: the family, and what reading it would need. An LMS1000 calls itself
# LMS1xxxx, an LMS100 LMS10x. Source of the names: SICKAG/sick_scan, isCompatibleDevice.
NOT_READ = {
    "LMS1XXX": ("LMS1000", "the telegrams of its 4 layers put together into one scan"),
    "LMS4": ("LMS4000", "a row of its own (600 scans a second, 70 deg) and a recording of its scan telegram"),
    "LRS": ("LRS", "a field of view of 360 deg and a recording of its scan telegram"),
    "MRS1": ("MRS1000", "one of its 4 layers chosen; a telegram holds one, some are cones"),
    "MRS6": ("MRS6000", "one of its 24 layers chosen; a telegram holds one, most are cones"),
    "NAV": ("NAV", "a field of view of 360 deg and a recording of its scan telegram"),
    "RMS": ("RMS radar", "ranges; a radar sends objects"),
    "TIM2": ("TiM2xx", "angles that count from straight ahead, and a recording of its scan telegram"),
    "TIM3": ("TiM3xx", "a recording of its scan telegram"),
    "TIM4": ("TiM4xx", "a recording of its scan telegram"),
}


def model_of(device: str) -> str | None:
    """Key in MODELS of the scanner with this DeviceIdent; None for one that is not read, or is unknown."""
    if device.upper().startswith(tuple(NOT_READ)):
        return None
    key = device[:4].lower() + "xx"
    return key if key in MODELS else None


def mismatch(device: str, configured: str) -> str:
    """Why the scanner with this DeviceIdent is not the configured model; "" where it is, or is unknown."""
    for start, (family, need) in NOT_READ.items():
        if device.upper().startswith(start):
            return (
                f"this is of the family {family} (it calls itself {device}), which is not read: that would "
                f"need {need}"
            )
    found = model_of(device)
    if found in (None, configured):
        return ""
    return (
        f"this is of the family {MODELS[found].name} (it calls itself {device}), expected "
        f"{MODELS[configured].name}; write model: {found}"
    )
