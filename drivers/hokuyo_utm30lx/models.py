"""The Hokuyo lasers that this driver reads, a row each, and those that it does not. No I/O.

Geometry, least and largest distance come from the device (PP); this is what PP does not report. Sources:
C-42-03320B, tables 3 and 4 (codes); C-42-04076 (UST); VV and PP of a UST-10LX, VV, PP and a scan of a
URG-04LX-UG01, printed by public drivers; ros-drivers/urg_c, pull request 4 (a URG that is queried for
intensities or further echoes answers nothing more until its power is cut).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

ModelName = Literal["utm_30lx", "ust", "urg_04lx_ug01"]

UTM_CODES = {1: "no_return", 2: "too_near", 3: "interference", 4: "near_limit"}  # 0 was seen too
URG_CODES = {
    0: "no_return",
    1: "too_weak",
    2: "too_weak",
    7: "unlike_neighbours",
    8: "two_waves",
    9: "error_twice",
    18: "too_bright",
    19: "not_measurable",
}


@dataclass(frozen=True, slots=True)
class Model:
    """What PP does not report, and the defaults of the settings."""

    name: str
    product: str  # what PROD, in VV, contains
    wires: tuple[Literal["device", "host"], ...]
    codes: Mapping[int, str]  # values below DMIN: why a beam has no distance
    range_min_m: float  # defaults of the settings
    range_max_m: float
    first_angle_deg: float = -135.0
    last_angle_deg: float = 135.0
    rate_hz: float = 40.0
    has_intensity: bool = True
    has_echoes: bool = False  # further ones, by Ethernet

    @property
    def defaults(self) -> dict[str, Any]:
        """Defaults of the settings that depend on the model."""
        names = "first_angle_deg", "last_angle_deg", "range_min_m", "range_max_m"
        return {name: getattr(self, name) for name in names}


MODELS: Mapping[str, Model] = {
    "utm_30lx": Model("UTM-30LX", "UTM-30LX", ("device", "host"), UTM_CODES, 0.1, 30.0, has_echoes=True),
    "ust": Model("UST", "UST-", ("host",), UTM_CODES, 0.06, 30.0),
    "urg_04lx_ug01": Model(
        name="URG-04LX-UG01",
        product="URG-04LX-UG01",
        wires=("device",),
        codes=URG_CODES,
        range_min_m=0.06,
        range_max_m=4.095,
        first_angle_deg=-119.5,
        last_angle_deg=119.9,
        rate_hz=10.0,
        has_intensity=False,
    ),
}

# Lasers that are not supported, by a part of PROD: what reading each would need.
NOT_READ = {
    "URG-04LX": "a VV reply with wrong sums accepted, and a recording of it",
    **dict.fromkeys(
        ("UBG-", "UHG-", "UTM-X00", "UGM-"), "a recording of its replies to VV and PP and of one scan"
    ),
    "UXM-": "a row for it (190 deg, 20 scans a second) and a recording of one scan with further echoes",
    "UAM-": "the safety protocol's replies, and a recording of one scan",
    "YVT-": "one plane chosen of a laser of many, and another protocol (VSSP)",
}


def model_of(product: str) -> str | None:
    """Key in MODELS of the laser with this product name; None for one that is not read, or is unknown."""
    return next((key for key, model in MODELS.items() if model.product in product), None)


def mismatch(product: str, configured: str) -> str:
    """Why the laser with this product name is not the configured model; "" where it is, or is unknown."""
    found = model_of(product)
    if found == configured:
        return ""
    if found is not None:
        return f"this is a {product}, expected a {MODELS[configured].name}; write model: {found}"
    for name, need in NOT_READ.items():
        if name in product:
            return f"this is a {product}, which is not read: that would need {need}"
    return ""
