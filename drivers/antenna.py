"""Name of the frame of a sensor's GNSS antenna."""


def antenna_of(sensor: str) -> str:
    """Frame of a sensor's antenna; its name cannot be that of a sensor."""
    return f"{sensor}/antenna"
