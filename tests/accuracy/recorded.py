"""Freiburg 079 against its official relations: as recorded, and with changed odometry or scans missing."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from service.encoding import LASER_SCAN, ODOMETRY, decode_frame, encode_frame
from service.geometry.poses import between, compose
from service.geometry.se2 import SE2
from service.offline.replay.replay import Replay, ReplayOptions, replay, write_replay
from service.offline.score.score import (
    NEAR_NS,
    RelationErrors,
    TrajectoryScore,
    read_relations,
    score,
)
from service.offline.score.trajectory import read_tum
from service.outputs import State
from tests.papers.report import Row, Section
from tests.shared_data import SHARED

FR079 = SHARED / "datasets" / "fr079"
RELATIONS = FR079 / "official.relations"
OFFSET_X_M = 0.038  # of the relations' frame before ours; fitted on this very set
Indices = npt.NDArray[np.int64]
LIVE, FINISHED = "trajectory_live.tum", "trajectory.tum"


def recorded(seeds: Sequence[int]) -> Section:  # one recording, no noise: seeds change nothing
    if not RELATIONS.exists():
        return Section("Freiburg 079", f"Left out: {RELATIONS} is not there; set CORRIDOR_SHARED.")
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain"
        mapped(FR079 / "fr079.mcap", plain)
        rows = [
            *_rows("raw, interpolated", plain / FINISHED, False, 0.0, 0.045, 0.80),
            *_rows("raw, interpolated, live", plain / LIVE, False, 0.0, None, None),
            *_rows("the scans nearest, within 0.12 s", plain / FINISHED, True, 0.0, 0.042, 0.41),
            *_rows("the same, offset of 0.038 m fitted", plain / FINISHED, True, OFFSET_X_M, 0.030, 0.41),
        ]
        reference = _errors(plain / FINISHED, False, 0.0)
        for what, spoil in (
            ("no odometry", WithoutOdometry()),
            ("odometry times 1.2", ScaledOdometry()),
            ("every second scan dropped", EverySecondScan()),
        ):
            spoilt, done = Path(folder) / "spoilt.mcap", Path(folder) / what.replace(" ", "_")
            rewrite(FR079 / "fr079.mcap", spoilt, spoil)
            mapped(spoilt, done)
            rows += _rows(what, done / FINISHED, False, 0.0, 1.5 * reference[0], 1.5 * reference[1])
    return Section(
        "Freiburg 079",
        "SICK laser, 360 beams at 4 Hz, noisy odometry, 423 m. Mean error against official.relations, "
        "order expected^-1 * relative (Kuemmerle et al. 2009). The bound of a changed recording is 1.5 "
        "times the error of the unchanged one. One run each; nothing is random.",
        rows,
    )


class WithoutOdometry:
    def __call__(self, type_name: str, payload: bytes) -> bytes | None:
        return None if type_name == ODOMETRY else payload


class ScaledOdometry:
    """Each step, distance and turn, 1.2 times as large: wheels a fifth smaller than configured."""

    def __init__(self) -> None:
        self._last: SE2 | None = None
        self._scaled = SE2()

    def __call__(self, type_name: str, payload: bytes) -> bytes | None:
        if type_name != ODOMETRY:
            return payload
        sample = decode_frame(type_name, payload, "base", 0)
        pose = SE2(sample.x_m, sample.y_m, sample.theta_rad)
        if self._last is not None:
            step = (self._last.inverse() @ pose).log()
            self._scaled @= SE2.exp(*(1.2 * rate for rate in step))
        self._last = pose
        new = self._scaled
        spoilt = replace(sample, x_m=new.x_m, y_m=new.y_m, theta_rad=new.theta_rad)
        return bytes(encode_frame(spoilt).payload)


class EverySecondScan:
    def __init__(self) -> None:
        self._scans = 0

    def __call__(self, type_name: str, payload: bytes) -> bytes | None:
        self._scans += type_name == LASER_SCAN
        return None if type_name == LASER_SCAN and self._scans % 2 == 0 else payload


def rewrite(source: Path, target: Path, spoil: Callable[[str, bytes], bytes | None]) -> None:
    """Copy a recording message by message, each changed by `spoil`, or left out where it gives None."""
    with source.open("rb") as read, target.open("wb") as written:
        writer = Writer(written, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(read).iter_messages():
            payload = spoil(schema.name, message.data)
            if payload is None:
                continue
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            writer.add_message(channels[channel.id], message.log_time, payload, message.publish_time)
        writer.finish()


def _errors(estimate: Path, near: bool, offset_x_m: float) -> tuple[float, float]:
    """Mean error, m and deg, in Kuemmerle's order.

    near: each stamp means the scan nearest to it, and pairs without one within NEAR_NS are left out; the
    stamps of the relations jitter against the recording. Else poses are interpolated at the stamps.
    """
    if not near:
        error = against_relations(estimate, RELATIONS, offset_x_m=offset_x_m)
        return error.translation_m.mean, error.rotation_deg.mean
    path = read_tum(estimate)
    pose = compose(path.pose, np.array([offset_x_m, 0.0, 0.0]))
    from_ns, to_ns, expected = read_relations(RELATIONS)
    first, first_off_ns = _nearest(path.stamp_ns, from_ns)
    second, second_off_ns = _nearest(path.stamp_ns, to_ns)
    kept = (first_off_ns <= NEAR_NS) & (second_off_ns <= NEAR_NS)
    relative = between(pose[first[kept]], pose[second[kept]])
    error = between(expected[kept], relative)
    return float(np.hypot(*error[:, :2].T).mean()), float(np.abs(np.degrees(error[:, 2])).mean())


def _nearest(sorted_ns: npt.NDArray[np.int64], stamp_ns: npt.NDArray[np.int64]) -> tuple[Indices, Indices]:
    """Which of sorted_ns is nearest to each stamp, and how far off, ns."""
    right = np.clip(np.searchsorted(sorted_ns, stamp_ns), 1, len(sorted_ns) - 1)
    left_is_nearer = stamp_ns - sorted_ns[right - 1] <= sorted_ns[right] - stamp_ns
    nearest = np.where(left_is_nearer, right - 1, right)
    return nearest, np.abs(sorted_ns[nearest] - stamp_ns)


def _rows(
    what: str, estimate: Path, near: bool, offset_x_m: float, most_m: float | None, most_deg: float | None
) -> list[Row]:
    error_m, error_deg = _errors(estimate, near, offset_x_m)
    return [
        Row(what, [error_m], "m", at_most=most_m, digits=4),
        Row(what, [error_deg], "deg", at_most=most_deg),
    ]


def mapped(recording: Path, out: Path, settings: Mapping[str, Any] | None = None) -> Replay:
    """Its result is in `out`. settings: other values of some keys, by box."""
    done = replay([recording], ReplayOptions(mapping={"settings": settings} if settings else {}))
    write_replay(done, out)
    return done


def percent_of(done: Replay, state: State) -> float:
    """Of the scans."""
    return 100.0 * sum(output.state == state for output in done.outputs) / len(done.outputs)


def against_truth(estimate: Path, truth: Path) -> TrajectoryScore:
    return score(estimate, truth)


def against_relations(
    estimate: Path, relations: Path, shift_s: float = 0.0, offset_x_m: float = 0.0
) -> RelationErrors:
    """In Kuemmerle's order, expected^-1 * relative."""
    return score(estimate, relations, shift_s, offset_x_m).errors[0]
