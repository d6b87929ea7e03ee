"""Health of GNSS: the geo-reference of the map, and faults of the newest fixes."""

import math
from collections.abc import Mapping

from drivers.counted import counted
from service.encoding import OK, WARNING, Status
from service.geometry.geo_reference import GeoReference

RECENT_NS = 10_000_000_000  # counts of this time are reported

# By counter, the worst first: level and words.
FAULTS = {
    "fixes_frozen": (WARNING, "the receiver repeats one position while the vehicle moves; is it stuck?"),
    "fixes_impossible": (WARNING, "fixes with impossible coordinates; is the receiver set up correctly?"),
    "fixes_contradicting": (
        WARNING,
        "fixes contradict the driven path and are not used: multipath, a jump, or a wrong lever arm",
    ),
    "fixes_of_another_receiver": (WARNING, "fixes of a second receiver; only the first receiver is used"),
    "fixes_without_covariance": (
        WARNING,
        "fixes without a covariance are not used; configure the receiver to send its accuracy",
    ),
    "fixes_out_of_order": (WARNING, "fixes whose stamps do not rise"),
    "fixes_without_scans": (WARNING, "fixes from moments without scans"),
    "fixes_too_poor": (OK, "fixes are worse than 10 m; is there open sky?"),
    "fixes_without_position": (OK, "the receiver has no position; indoors this is normal"),
}


class GnssHealth:
    """Reports the counts of the last seconds."""

    def __init__(self) -> None:
        self._counted: dict[str, int] = {}
        self._rose_ns: dict[str, int] = {}

    def status(
        self, counters: Mapping[str, int], reference: GeoReference | None, now_ns: int
    ) -> Status | None:
        """None where no fix has come, or no graph uses fixes. now_ns: host monotonic."""
        fixes = {name: count for name, count in counters.items() if name.startswith("fixes_")}
        if not fixes.keys() - {"fixes_passed_over"}:
            return None
        self._rose_ns = {name: ns for name, ns in self._rose_ns.items() if name in fixes}  # of this map
        for name, count in fixes.items():
            if count > self._counted.get(name, 0):
                self._rose_ns[name] = now_ns
        self._counted = fixes
        values = {name: str(count) for name, count in sorted(fixes.items())}
        values["referenced"] = str(reference is not None).lower()
        level, words = OK, "not referenced yet: fixes must agree with 100 to 300 m of the driven path"
        if reference is not None:
            yaw_sigma_deg = math.degrees(reference.yaw_sigma_rad)
            values |= {
                "position_sigma_m": f"{reference.position_sigma_m:.2f}",
                "yaw_sigma_deg": f"{yaw_sigma_deg:.2f}",
                "map_yaw_enu_deg": f"{math.degrees(reference.pose_enu_map.theta_rad):.2f}",
                "origin": f"{reference.origin.latitude_deg:.7f} {reference.origin.longitude_deg:.7f}",
            }
            words = (
                f"referenced to {reference.position_sigma_m:.1f} m and {yaw_sigma_deg:.1f} deg "
                f"by {counted(reference.fixes, 'fix', 'fixes')}"
            )
        for name, (fault_level, fault) in FAULTS.items():
            if name in self._rose_ns and now_ns - self._rose_ns[name] <= RECENT_NS:
                return Status("gnss", fault_level, f"{fault} ({fixes[name]} so far); {words}", values)
        return Status("gnss", level, words, values)
