"""Whether a rate that a device states is the requested one."""

RATE_TOLERANCE = 0.05  # motors turn up to 1 % off, and integers of a coarse unit lie beside the rate


def same_rate(found: float, wanted: float) -> bool:
    """Both in one unit: 24.97 Hz is 25 Hz."""
    return abs(found - wanted) <= RATE_TOLERANCE * wanted
