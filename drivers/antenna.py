"""What the GNSS antenna of a sensor is called."""


def antenna_of(sensor: str) -> str:
    """Frame of a sensor's antenna where it is told apart from the sensor; no sensor can be called so."""
    return f"{sensor}/antenna"
