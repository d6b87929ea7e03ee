"""The demo with a drawn file of faults on both its devices, each in a process of its own."""

import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from service.encoding import decode_diagnostics, encode_pose
from service.offline.replay.replay import ReplayOptions, replay
from service.recording.mcap_reader import Recording
from tests.chaos.campaign import fault_line, kinds_for
from tests.drivers.faulty_devices import BENCHES

DEVICES = {"front": "lms100 cola_a", "base": "create2"}
STOP_TIMEOUT_S = 60.0
CALM_S = 20.0  # at the end


def plan(seconds: float, seed: int) -> str:
    """A file of faults for the demo, all kinds on both devices, calm at the end."""
    text = "faults:\n"
    for number, (device, bench) in enumerate(DEVICES.items()):
        chance = np.random.default_rng([seed, number])
        for kind in kinds_for(BENCHES[bench]):
            text += f"  - {{device: {device}, {fault_line(kind, chance, seconds, seconds - CALM_S)}}}\n"
    return text


def run_machine(seconds: float, seed: int) -> tuple[str, float | None]:
    """What did not go as it should, "" where all did; and how far from the truth the poses are, RMSE, m.

    While neither laser nor wheels are there nobody can know the way, so that is told and not judged.
    """
    with TemporaryDirectory(prefix="corridor-chaos-") as folder:
        faults = Path(folder) / "faults.yaml"
        faults.write_text(plan(seconds, seed))
        command = [str(Path(sys.executable).parent / "corridor"), "demo", "--json", "--seconds", str(seconds)]
        command += ["--seed", str(seed), "--faults", str(faults), "--out", folder]
        timeout_s = seconds + STOP_TIMEOUT_S
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
        except subprocess.TimeoutExpired:
            return f"the demo did not end within {timeout_s:g} s", None
        if done.returncode != 0:
            return f"the demo ended with {done.returncode}: {done.stderr[-2000:]}", None
        summary = json.loads(done.stdout)
        rmse_m = summary["position_rmse_m"]
        recording = Recording([Path(summary["session"])])
        (*_, last) = recording.messages(["/diagnostics"])
        states = {status.name: status.values.get("state") for status in decode_diagnostics(last.payload)}
        down = [name for name in DEVICES if states[f"sensor/{name}"] != "streaming"]
        if down:
            return f"{' and '.join(down)} did not come back", rmse_m
        recorded = [message.payload for message in recording.messages(["/pose"])]
        replayed = replay([Path(summary["session"])], ReplayOptions())
        if [encode_pose(output, 0).payload for output in replayed.outputs] != recorded:
            return "the replay gives other poses", rmse_m
        return "", rmse_m
