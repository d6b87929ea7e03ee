"""Freiburg 079 against its official relations: as recorded, and with odometry spoilt or scans missing."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from drivers.frames import OdometrySample
from service.encoding import LASER_SCAN, ODOMETRY, decode_frame, encode_frame
from service.geometry.se2 import SE2
from service.offline.replay.replay import ReplayOptions, replay, write_replay
from service.offline.score.score import RelationsScore, score
from tests.papers.report import Row, Section
from tests.shared_data import SHARED

FR079 = SHARED / "datasets" / "fr079"
RELATIONS = FR079 / "official.relations"
LIVE, FINISHED = "trajectory_live.tum", "trajectory.tum"


def recorded(seeds: Sequence[int]) -> Section:  # one recording, no noise: seeds change nothing
    if not RELATIONS.exists():
        return Section("Freiburg 079", f"Left out: {RELATIONS} is not there; set CORRIDOR_SHARED.")
    with tempfile.TemporaryDirectory() as folder:
        plain = _mapped(FR079 / "fr079.mcap", Path(folder) / "plain")
        reference = _errors(plain / FINISHED)
        rows = [
            *_rows("raw, interpolated", reference, 0.045, 0.80),
            *_rows("raw, interpolated, live", _errors(plain / LIVE), None, None),
        ]
        for what, spoil in (
            ("no odometry", WithoutOdometry()),
            ("odometry times 1.2", ScaledOdometry()),
            ("every second scan dropped", EverySecondScan()),
        ):
            spoilt = Path(folder) / "spoilt.mcap"
            rewrite(FR079 / "fr079.mcap", spoilt, spoil)
            done = _mapped(spoilt, Path(folder) / what.replace(" ", "_"))
            rows += _rows(what, _errors(done / FINISHED), 1.5 * reference[0], 1.5 * reference[1])
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
    """Each step, way and turn, 1.2 times as large: wheels that are a fifth smaller than believed."""

    def __init__(self) -> None:
        self._last: SE2 | None = None
        self._believed = SE2()

    def __call__(self, type_name: str, payload: bytes) -> bytes | None:
        if type_name != ODOMETRY:
            return payload
        sample = decode_frame(type_name, payload, "base", 0)
        assert isinstance(sample, OdometrySample)
        pose = SE2(sample.x_m, sample.y_m, sample.theta_rad)
        if self._last is not None:
            step = (self._last.inverse() @ pose).log()
            self._believed @= SE2.exp(*(1.2 * rate for rate in step))
        self._last = pose
        new = self._believed
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
            assert schema is not None
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
