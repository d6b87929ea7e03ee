"""Freiburg 079 against its official relations: as recorded, and with odometry spoilt or scans missing."""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from drivers.frames import Frame, LaserScan, OdometrySample
from service.geometry.se2 import SE2
from service.offline.replay.replay import ReplayOptions, replay, write_replay
from service.offline.score.score import RelationsScore, score
from service.recording.mcap_source import open_session
from tests.papers.report import Row, Section
from tests.recorded_drive import record
from tests.shared_data import SHARED

FR079 = SHARED / "datasets" / "fr079"
RELATIONS = FR079 / "official.relations"
LIVE, FINISHED = "trajectory_live.tum", "trajectory.tum"


def recorded(seeds: Sequence[int]) -> Section:  # one recording, no noise: seeds change nothing
    if not RELATIONS.exists():
        return Section("Freiburg 079", f"Left out: {RELATIONS} is not there; set CORRIDOR_SHARED.")
    session = open_session([FR079 / "fr079.mcap"])
    frames = list(session.frames())
    with tempfile.TemporaryDirectory() as folder:
        plain = _mapped(FR079 / "fr079.mcap", Path(folder) / "plain")
        reference = _errors(plain / FINISHED)
        rows = [
            *_rows("raw, interpolated", reference, 0.045, 0.80),
            *_rows("raw, interpolated, live", _errors(plain / LIVE), None, None),
        ]
        for what, spoil in (
            ("no odometry", without_odometry),
            ("odometry times 1.2", scaled_odometry),
            ("every second scan dropped", every_second_scan),
        ):
            spoilt = record(spoil(frames), session.mountings, Path(folder) / what / "in", 0)
            done = _mapped(spoilt, Path(folder) / what / "out")
            rows += _rows(what, _errors(done / FINISHED), 1.5 * reference[0], 1.5 * reference[1])
    return Section(
        "Freiburg 079",
        "SICK laser, 360 beams at 4 Hz, noisy odometry, 423 m. Mean error against official.relations, "
        "order expected^-1 * relative (Kuemmerle et al. 2009). The bound of a changed recording is 1.5 "
        "times the error of the unchanged one. One run each; nothing is random.",
        rows,
    )


def without_odometry(frames: Sequence[Frame]) -> list[Frame]:
    return [frame for frame in frames if not isinstance(frame, OdometrySample)]


def scaled_odometry(frames: Sequence[Frame]) -> list[Frame]:
    """Each step, way and turn, 1.2 times as large: wheels that are a fifth smaller than believed."""
    spoilt: list[Frame] = []
    last, believed = None, SE2()
    for frame in frames:
        if isinstance(frame, OdometrySample):
            pose = SE2(frame.x_m, frame.y_m, frame.theta_rad)
            step = (pose if last is None else last).inverse() @ pose
            last, believed = pose, believed @ SE2.exp(*(1.2 * rate for rate in step.log()))
            frame = replace(frame, x_m=believed.x_m, y_m=believed.y_m, theta_rad=believed.theta_rad)
        spoilt.append(frame)
    return spoilt


def every_second_scan(frames: Sequence[Frame]) -> list[Frame]:
    left_out = {id(scan) for scan in [f for f in frames if isinstance(f, LaserScan)][1::2]}
    return [frame for frame in frames if id(frame) not in left_out]


def _mapped(recording: Path, out: Path) -> Path:
    write_replay(replay([recording], ReplayOptions()), out)
    return out


def _errors(estimate: Path) -> tuple[float, float]:
    """Mean error, m and deg, in Kuemmerle's order, of poses interpolated at the stamps of the relations."""
    report = score(estimate, RELATIONS)
    assert isinstance(report, RelationsScore)
    return report.errors[0].translation_m.mean, report.errors[0].rotation_deg.mean


def _rows(what: str, errors: tuple[float, float], most_m: float | None, most_deg: float | None) -> list[Row]:
    error_m, error_deg = errors
    return [
        Row("", what, [error_m], "m", at_most=most_m, digits=4),
        Row("", what, [error_deg], "deg", at_most=most_deg),
    ]
