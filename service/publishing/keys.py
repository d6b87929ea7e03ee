"""Key expressions on Zenoh. Version first, vehicle second: one rule or one subscription covers a fleet."""

ROOT = "corridor/v1"


def vehicle_key(vehicle: str, channel: str) -> str:
    """Key of a channel: "front/scan" of veh1 is at corridor/v1/veh1/front/scan."""
    return f"{ROOT}/{vehicle}/{channel}"


def alive_key(vehicle: str, component: str) -> str:
    """Key of the liveliness token that exists while a component works."""
    return vehicle_key(vehicle, f"alive/{component}")
