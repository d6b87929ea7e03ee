"""evo, by its command line alone (GPL-3.0: nothing of it is imported), against `corridor score`."""

import json
import zipfile
from pathlib import Path

from service.offline.score.trajectory import read_tum, write_tum
from tests.interop.programs import InteropError, Venv, run
from tests.interop.session import CORRIDOR, session

SLACK = 2e-6  # m or degrees: TUM files carry 9 decimals, evo turns in three dimensions
RPE_SHARE = 0.2  # each has its own idea of which pose is "a metre further on"
STATISTICS = {"rms": "rmse", "mean": "mean", "max": "max"}  # ours, evo's


def run_evo(venv: Venv, folder: Path) -> str:
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
