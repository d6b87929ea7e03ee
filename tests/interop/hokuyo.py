"""SCIP clients against a fake UTM-30LX-EW that stands in an empty room."""

import math
from pathlib import Path

import numpy as np

from simulators.device import Beams, Sweep
from simulators.hokuyo_optics import FULL_INTENSITY
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from simulators.wire import TcpWire
from tests.interop.programs import InteropError, Venv, run_client

WALLS_M = {"ahead": 6.0, "behind": 2.0, "left": 4.5, "right": 3.0}
SIGMA_M = 0.005
SILENT_RAD = (1.0, 1.2)  # a window to the left: no echo
SERIAL = "00805037"
NO_ECHO_MM = 65_533


class Room:
    """A SweepSource: four walls around the laser, no two of them as far away."""

    def __init__(self, seed: int) -> None:
        self._noise = np.random.default_rng(seed)

    def sweep(self, beams: Beams) -> Sweep:
        """The laser stands, so the moment does not matter. A brighter echo the further ahead."""
        angle_rad = beams.first_angle_rad + beams.step_rad * np.arange(beams.count)
        cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
        along_m = np.where(cosine >= 0.0, WALLS_M["ahead"], WALLS_M["behind"])
        across_m = np.where(sine >= 0.0, WALLS_M["left"], WALLS_M["right"])
        with np.errstate(divide="ignore"):
            range_m = np.minimum(along_m / np.abs(cosine), across_m / np.abs(sine))
        range_m += np.clip(self._noise.normal(0.0, SIGMA_M, beams.count), -4 * SIGMA_M, 4 * SIGMA_M)
        silent = (angle_rad > SILENT_RAD[0]) & (angle_rad < SILENT_RAD[1])
        return Sweep(
            np.where(silent, math.nan, range_m).astype(np.float32),
            np.where(silent, 0.0, 0.5 + 0.4 * cosine).astype(np.float32),
        )


def run_hokuyolx(venv: Venv, folder: Path) -> str:
    setup = Utm30lxSetup(wire="ethernet", serial_number=SERIAL, no_return_mm=NO_ECHO_MM)
    device = FakeUtm30lx(Room(seed=1), setup)
    with TcpWire(device) as (host, port):
        facts = {
            "host": host,
            "port": port,
            "walls_mm": {name: 1000.0 * distance_m for name, distance_m in WALLS_M.items()},
            "sigma_mm": 1000.0 * SIGMA_M,
            "silent_rad": SILENT_RAD,
            "no_echo_mm": NO_ECHO_MM,
            "white": FULL_INTENSITY,
            "serial": SERIAL,
        }
        seen = run_client(venv, "hokuyolx_client.py", facts, folder)
    if device.counters["commands_refused"]:
        raise InteropError(f"the device refused {device.counters['commands_refused']} commands")
    return (
        f"{seen['scans']} scans, {seen['beams']} beams, {seen['error_mm']:.2f} mm off the walls on average, "
        f"sigma {seen['sigma_mm']:.1f} mm, stamps at most {seen['stamp_ms']:.0f} ms before arrival"
    )
