"""Name of the frame of a sensor's GNSS antenna."""


def antenna_of(sensor: str) -> str:
    """Frame of a sensor's antenna where it is distinguished from the sensor; no sensor can be called so."""
    return f"{sensor}/antenna"
