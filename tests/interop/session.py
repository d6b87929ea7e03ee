"""One short drive of the demo, recorded for an independent CDR decoder, a viewer's checker, and evo."""

import json
import sys
import zipfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.demo import interpolate
from service.encoding.outputs import decode_pose
from service.geometry.se2 import SE2
from service.offline.score.trajectory import read_tum, write_tum
from service.recording.mcap_reader import Recording
from tests.interop.programs import InteropError, Venv, run, run_client

SECONDS = 15
CORRIDOR = str(Path(sys.executable).parent / "corridor")
STATUS_OK = "ok"
SLACK = 2e-6  # m or degrees: TUM files carry 9 decimals, evo turns in three dimensions
RPE_SHARE = 0.2  # each selects the pose "a metre further on" differently
STATISTICS = {"rms": "rmse", "mean": "mean", "max": "max"}  # ours, evo's


@dataclass(frozen=True, slots=True)
class Session:
    """Files of the demo."""

    mcap: Path
    truth: Path  # stamp_ns x_m y_m theta_rad, host's monotonic clock, frame of the start
    utc_offset_ns: int  # Unix time minus monotonic time

    def true_poses(self, stamps_ns: list[int]) -> list[SE2]:
        """True poses at these Unix times, in the frame of the vehicle's start."""
        monotonic_ns = np.array(stamps_ns, dtype=np.int64) - self.utc_offset_ns
        return interpolate(np.loadtxt(self.truth, ndmin=2), monotonic_ns)


def session(folder: Path) -> Session:
    """Record it at the first call, find it again at the next. Raises InteropError."""
    out = folder / "session"
    if not (out / "done").exists():
        facts = run([CORRIDOR, "demo", "--json", "--seconds", str(SECONDS), "--out", str(out)])
        if json.loads(facts)["scans"] < 40 * SECONDS:
            raise InteropError(f"the demo mapped {json.loads(facts)['scans']} scans in {SECONDS} s")
        (out / "done").touch()
    (mcap,) = out.glob("*.mcap")
    offset_ns = int(Recording([mcap]).metadata["clock"]["utc_offset_ns"])
    return Session(mcap, out / "truth.txt", offset_ns)


def run_mcap_ros2(venv: Venv, folder: Path) -> str:
    """Values of each type are compared in tests/service, with rosbags; here every message is decoded."""
    drive = session(folder)
    messages = list(Recording([drive.mcap]).messages())
    stamps_ns = [decode_pose(m.payload).stamp_ns for m in messages if m.channel == "pose"]
    facts = {
        "mcap": str(drive.mcap),
        "counts": Counter(f"/{message.channel}" for message in messages),
        "stamps_ns": stamps_ns,
        "true_poses": [(pose.x_m, pose.y_m, pose.theta_rad) for pose in drive.true_poses(stamps_ns)],
    }
    seen = run_client(venv, "mcap_ros2_client.py", facts, folder)
    return (
        f"{seen['messages']} messages on {len(facts['counts'])} topics decoded, "
        f"poses {1000 * seen['rmse_m']:.1f} mm off the truth"
    )


def run_rerun(venv: Venv, folder: Path) -> str:
    drive = session(folder)
    home = folder / "rerun-home"
    home.mkdir(exist_ok=True)
    rerun = str(venv.bin / "rerun")
    run([rerun, "analytics", "disable"], home)
    table = run([rerun, "mcap", "check", "--full", str(drive.mcap)], home)
    rows = {cells[3]: cells for cells in map(str.split, table.splitlines()) if len(cells) >= 4}
    topics = [topic.name for topic in Recording([drive.mcap]).topics]
    bad = [topic for topic in topics if rows.get(topic, ("",))[0] != STATUS_OK]
    if bad:
        raise InteropError(f"rerun mcap check does not call {', '.join(bad)} ok:\n{table}")
    return f"mcap check --full calls all {len(topics)} topics ok"


def run_evo(venv: Venv, folder: Path) -> str:
    """By its command line alone (GPL-3.0: nothing of it is imported), against `corridor score`."""
    drive = session(folder)
    run([CORRIDOR, "replay", str(drive.mcap), "--out", str(folder / "replayed")])
    estimate, truth = folder / "replayed" / "trajectory.tum", folder / "truth.tum"
    stamps_ns = read_tum(estimate).stamp_ns.tolist()
    write_tum(truth, zip(stamps_ns, drive.true_poses(stamps_ns), strict=True))
    ours = json.loads(run([CORRIDOR, "score", "--json", str(estimate), str(truth)]))
    ape = [str(venv.bin / "evo_ape"), "tum", str(truth), str(estimate)]
    for relation, unit in (("trans_part", "m"), ("angle_deg", "deg")):
        for aligned, options in (("ate", []), ("ate_aligned", ["--align"])):
            theirs = _evo([*ape, "--pose_relation", relation, *options], folder)
            _compare(ours[f"{aligned}_{unit}"], theirs, f"{aligned}_{unit}")
    rpe = [
        str(venv.bin / "evo_rpe"),
        "tum",
        str(truth),
        str(estimate),
        "--all_pairs",
        "--pairs_from_reference",
    ]
    rpe_m = _evo([*rpe, "--delta", "1", "--delta_unit", "m"], folder)["rmse"]
    if abs(rpe_m / ours["rpe_m"]["rms"] - 1.0) > RPE_SHARE:
        raise InteropError(f"RPE over 1 m: evo {rpe_m:.6f} m, ours {ours['rpe_m']['rms']:.6f} m")
    as_is_mm, aligned_mm, rpe_mm = (1000 * ours[key]["rms"] for key in ("ate_m", "ate_aligned_m", "rpe_m"))
    return (
        f"ATE {as_is_mm:.3f} mm as is, {aligned_mm:.3f} mm aligned, and angles: the same to {SLACK:g}; "
        f"RPE {rpe_mm:.2f} mm, evo's {1000 * rpe_m:.2f} mm"
    )


def _evo(command: list[str], folder: Path) -> dict[str, float]:
    results = folder / "evo.zip"
    results.unlink(missing_ok=True)
    home = folder / "evo-home"
    home.mkdir(exist_ok=True)
    run([*command, "--save_results", str(results), "--no_warnings"], home)
    statistics: dict[str, float] = json.loads(zipfile.ZipFile(results).read("stats.json"))
    return statistics


def _compare(ours: dict[str, float], theirs: dict[str, float], what: str) -> None:
    for our_name, evo_name in STATISTICS.items():
        if abs(ours[our_name] - theirs[evo_name]) > SLACK:
            raise InteropError(f"{what} {our_name}: evo {theirs[evo_name]:.9f}, ours {ours[our_name]:.9f}")
