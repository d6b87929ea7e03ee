"""Mountings, wheel scales and time offsets of the sensors of a recorded drive, with uncertainties.

Each laser maps the drive alone; its path is then compared with the wheels, the gyro and
where the other lasers were. What the drive leaves open is reported, and stays as it is configured.
"""

import io
import json
import logging
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from pydantic import ValidationError
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML

from drivers.frames import ImuSample, LaserScan, OdometrySample
from drivers.sensor_section import MAX_LATENCY_MS, MIN_LATENCY_MS
from service.config import ServiceConfig, load_config, parse_config, recorded_config
from service.errors import InputError, UsageError
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.offline.calibrate.fit import Fit, fit_gyro, fit_lasers, fit_wheels
from service.offline.calibrate.tracks import LaserMapping, LaserTrack, gyro_track, wheel_track
from service.offline.replay.replay import group_sessions
from service.offline.replay.setup import overlay
from service.recording.choice import NO_CHOICE, Choice
from service.recording.mcap_source import Session, open_session

log = logging.getLogger(__name__)

# largest uncertainty of a value that is used, one sigma
ENOUGH = {"m": 0.02, "deg": 0.5, "ms": 5.0, "%": 1.0}
DRIVE_ON = "; drive two minutes with straights and turns to both sides"
MIRRORED = (
    "{wheels} counts turns to the other side than {laser} sees them, so no mounting and no wheels can be "
    "determined: is {laser} upside down (mounting: upside_down), or are the left and the right wheel swapped?"
)
GYRO_OFF_PERCENT = 5.0  # a scale so far from 1 is no error of a gyro
Changes = dict[str, dict[str, Any]]  # sensor -> key -> value; a mapping is merged into the one that is there


@dataclass(frozen=True, slots=True)
class Value:
    """One estimated value."""

    name: str
    value: float
    sigma: float
    unit: str  # m, deg, ms, %, deg/s
    was: float | None = None  # as configured

    @property
    def is_known(self) -> bool:
        return self.sigma <= ENOUGH.get(self.unit, math.inf)

    def __str__(self) -> str:
        was = "" if self.was is None else f"   configured {self.was:.{_digits(self.unit)}f}"
        open_ = "" if self.is_known else f"   too uncertain to be used{DRIVE_ON}"
        digits = _digits(self.unit)
        return f"{self.name:<16} {self.value:9.{digits}f} +- {self.sigma:.{digits}f} {self.unit}{was}{open_}"


def _digits(unit: str) -> int:
    return 4 if unit == "m" else 3


@dataclass(frozen=True, slots=True)
class SensorCalibration:
    """Values of one sensor. Latency is from the stamp to the last byte, as recorded."""

    sensor: str
    kind: Literal["laser", "wheels", "gyro"]
    values: tuple[Value, ...]
    latency_p50_ms: float | None  # None: it could not be calibrated
    latency_p99_ms: float | None
    notes: tuple[str, ...] = ()

    @property
    def latency(self) -> str:
        if self.latency_p50_ms is None or self.latency_p99_ms is None:
            return ""
        return f", from stamp to last byte p50 {self.latency_p50_ms:.1f} ms, p99 {self.latency_p99_ms:.1f} ms"


@dataclass(slots=True)
class Calibration:
    """Values of a drive. patch is YAML to be merged into a config; config that config, merged already."""

    session: str
    reference: str  # the laser whose clock the others' offsets are counted against
    seconds: float
    sensors: list[SensorCalibration] = field(default_factory=list)
    patch: str = ""
    config: str = ""  # empty where no config is known

    def __str__(self) -> str:
        lines = [f"{self.session}: {self.seconds:.0f} s; times are against {self.reference}"]
        for one in self.sensors:
            lines.append(f"{one.sensor} ({one.kind}){one.latency}")
            lines += [f"  {value}" for value in one.values] + [f"  {note}" for note in one.notes]
        return "\n".join([*lines, "", self.patch or "nothing to change"]).rstrip()


def calibrate(
    paths: Sequence[Path],
    config_path: Path | None = None,
    reference: str | None = None,
    progress: Callable[[float], None] = lambda share: None,
    choice: Choice = NO_CHOICE,
) -> Calibration:
    """Calibrate by one recorded drive.

    config_path   the config to be corrected; None: the one in the recording, if there is one
    reference     the laser the others are compared with; None: the one with most scans
    choice        topics and frames; what it leaves open is as in the config, else found

    Raises InputError where the recording has no laser, none that maps alone, or nothing to compare it with;
    UsageError for several drives and for a reference that is no laser of the recording; ConfigError.
    """
    given = load_config(config_path) if config_path is not None else None
    drives = group_sessions(paths)
    if len(drives) > 1:
        raise UsageError(
            f"{' and '.join(str(drive[0]) for drive in drives)} are {len(drives)} drives; calibrate by one"
        )
    session = open_session(drives[0], choice if given is None else choice.over(given.replay))
    for warning in session.warnings:
        log.warning("%s", warning)
    recorded = recorded_config(session.recording, parse_config, is_replaced=given is not None)
    config = given or recorded
    found = _Findings(recorded or config)
    lasers = sorted(session.scan_counts, key=lambda name: (-session.scan_counts[name], name))
    if reference is not None and reference not in lasers:
        raise UsageError(
            f"--reference {reference}: no laser of this recording; it has {' and '.join(lasers)}"
        )
    tracks, wheels, gyros, notes = _tracks(session, lasers, progress)
    for loss in session.losses:
        log.warning("%s", loss)
    if reference is None:
        reference = next((name for name in lasers if name in tracks), None)
    if reference is None or reference not in tracks:
        raise InputError(f"{paths[0]}: {'; '.join(notes.values())}")
    first = tracks[reference]
    mounting, mounting_fit = found.take_wheels(first, wheels)
    for name, samples in gyros.items():
        if (gyro := gyro_track(samples)) is not None:
            found.take(name, "gyro", gyro.latency_ms, *_of_gyro(fit_gyro(first, gyro)))
    for name in lasers:
        was = found.configured(name, "mounting")
        if name not in tracks:
            found.sensors.append(SensorCalibration(name, "laser", (), None, None, (notes[name],)))
        elif name == reference:
            values = [] if mounting_fit is None else _of_mounting(mounting, mounting_fit, was)
            found.take(name, "laser", first.latency_ms, values)
        else:
            values = _of_other(mounting, mounting_fit, fit_lasers(first, tracks[name]), was)
            found.take(name, "laser", tracks[name].latency_ms, values)
    if not any(one.values for one in found.sensors):
        raise InputError(f"{paths[0]}: {reference} is alone; there are no wheels, no gyro and no other laser")
    found.leave_out_what_is_refused(config)
    seconds = float(first.stamp_ns[-1] - first.stamp_ns[0]) * 1e-9
    return Calibration(str(paths[0]), reference, seconds, found.sensors, *patched(found.changes, config))


def _tracks(
    session: Session, lasers: Sequence[str], progress: Callable[[float], None]
) -> tuple[
    dict[str, LaserTrack], dict[str, list[OdometrySample]], dict[str, list[ImuSample]], dict[str, str]
]:
    """One walk through the recording; the notes give the reason where a laser has no track."""
    mappings = {name: LaserMapping(name) for name in lasers}
    wheels: defaultdict[str, list[OdometrySample]] = defaultdict(list)
    gyros: defaultdict[str, list[ImuSample]] = defaultdict(list)
    begin_ns, end_ns = session.recording.first_log_ns, session.recording.last_log_ns
    for frame in session.frames():
        if isinstance(frame, LaserScan):
            mappings[frame.sensor].add(frame)
            progress((frame.arrived_ns - begin_ns) / max(end_ns - begin_ns, 1))
        elif isinstance(frame, OdometrySample):
            wheels[frame.sensor].append(frame)
        elif isinstance(frame, ImuSample):
            gyros[frame.sensor].append(frame)
    tracks, notes = {}, {}
    for name, mapping in mappings.items():
        try:
            tracks[name] = mapping.finish()
        except InputError as error:
            notes[name] = str(error)
    return tracks, wheels, gyros, notes


@dataclass(slots=True)
class _Findings:
    """What is found of each sensor, and what of it changes the config.

    before    the config by which stamps and counts were made; None: it is not known
    """

    before: ServiceConfig | None
    sensors: list[SensorCalibration] = field(default_factory=list)
    changes: Changes = field(default_factory=dict)

    def configured(self, sensor: str, key: str, default: Any = None) -> Any:
        """A setting of a sensor, the default where there is none."""
        settings = None if self.before is None else self.before.sensors.get(sensor)
        return getattr(settings, key, default)

    def take_wheels(
        self, first: LaserTrack, wheels: dict[str, list[OdometrySample]]
    ) -> tuple[SE2, Fit | None]:
        """pose_base_laser of the reference by the wheels with most samples; without wheels as configured."""
        chosen: tuple[SE2, Fit] | None = None
        for name in sorted(wheels, key=lambda name: (-len(wheels[name]), name)):
            if (track := wheel_track(wheels[name])) is None:
                continue
            base_m = self.configured(name, "wheel_base_m")
            fit = fit_wheels(first, track, base_m)
            values = [
                _value("scale", fit, "scale", 100.0, "%"),
                _value("turn scale", fit, "turn_scale", 100.0, "%"),
                _value("turn per metre", fit, "turn_per_m", math.degrees(1.0), "deg/m"),
                _late_by(fit),
            ]
            mirrored = fit["turn_scale"] <= 0.0
            notes = [MIRRORED.format(laser=first.sensor, wheels=name)] if mirrored else []
            self.take(name, "wheels", track.latency_ms, values, notes)
            if mirrored:  # it is not known which sensor is wrong, so neither is the laser's mounting
                continue
            if base_m is not None and all(value.is_known for value in values[:2]):
                scales = (self.configured(name, f"{side}_scale") for side in ("left", "right"))
                self.changes.setdefault(name, {}).update(wheel_settings(fit, base_m, *scales))
            if chosen is None:
                chosen = SE2(fit["x_m"], fit["y_m"], fit["yaw_rad"]), fit
        if chosen is None:
            at = self.configured(first.sensor, "mounting")
            return SE2() if at is None else SE2(at.x_m, at.y_m, math.radians(at.yaw_deg)), None
        return chosen

    def take(
        self,
        name: str,
        kind: Literal["laser", "wheels", "gyro"],
        latency_ms: Floats,
        values: Sequence[Value],
        notes: Sequence[str] = (),
    ) -> None:
        """Note what was found, and what of it changes the config: a mounting, a latency."""
        p50, p99 = (float(p) for p in np.percentile(latency_ms, (50, 99)))
        all_notes = list(notes)
        found = {value.name: value for value in values}
        new: dict[str, Any] = {}
        if kind == "laser" and {"x", "y", "yaw"} <= found.keys():
            place = {"x": "x_m", "y": "y_m", "yaw": "yaw_deg"}
            known = {place[key]: round(found[key].value, 4) for key in place if found[key].is_known}
            if known:
                new["mounting"] = known
        offset = found.get("stamps late by")
        if offset is not None and offset.is_known:
            latency = float(self.configured(name, "latency_ms", 0.0)) + offset.value
            if MIN_LATENCY_MS <= latency <= MAX_LATENCY_MS:
                new["latency_ms"] = round(latency, 2)
            else:
                all_notes.append(
                    f"a latency of {latency:.1f} ms is none that a config takes ({MIN_LATENCY_MS:g} to "
                    f"{MAX_LATENCY_MS:g} ms)"
                )
        if new:
            self.changes.setdefault(name, {}).update(new)
        self.sensors.append(SensorCalibration(name, kind, tuple(values), p50, p99, tuple(all_notes)))

    def leave_out_what_is_refused(self, config: ServiceConfig | None) -> None:
        """Leave out a sensor of another type in the config, or whose values the config does not accept."""
        for name in list(self.changes):
            settings = None if config is None else config.sensors.get(name)
            if settings is None or not (refused := why_not_taken(self.changes[name], settings)):
                continue
            del self.changes[name]
            note = f"stays as it is, for the config's {name} ({settings.type}) does not take it: {refused}"
            self.sensors = [
                replace(one, notes=(*one.notes, note)) if one.sensor == name else one for one in self.sensors
            ]


def _value(name: str, fit: Fit, key: str, factor: float, unit: str) -> Value:
    return Value(name, factor * fit[key], factor * fit.sigma(key), unit)


def _late_by(fit: Fit) -> Value:
    return _value("stamps late by", fit, "offset_s", 1e3, "ms")


def _of_mounting(mounting: SE2, fit: Fit, was: Any, more: Fit | None = None) -> list[Value]:
    """was: as configured. more: of this laser against the reference; its uncertainty comes on top, that of
    the yaw by a lever.
    """
    values = []
    for key, unit, value in (("x_m", "m", mounting.x_m), ("y_m", "m", mounting.y_m)):
        lever = 0.0 if more is None else math.hypot(more["x_m"], more["y_m"]) * fit.sigma("yaw_rad")
        sigma = math.hypot(fit.sigma(key), lever, 0.0 if more is None else more.sigma(key))
        values.append(Value(key.removesuffix("_m"), value, sigma, unit, getattr(was, key, None)))
    sigma_rad = math.hypot(fit.sigma("yaw_rad"), 0.0 if more is None else more.sigma("yaw_rad"))
    yaw_deg = math.degrees(mounting.theta_rad)
    return [*values, Value("yaw", yaw_deg, math.degrees(sigma_rad), "deg", getattr(was, "yaw_deg", None))]


def _of_other(mounting: SE2, mounting_fit: Fit | None, other: Fit, was: Any) -> list[Value]:
    """Calibration of a laser that was compared with the reference."""
    pose = mounting @ SE2(other["x_m"], other["y_m"], other["yaw_rad"])
    fits = (other, was) if mounting_fit is None else (mounting_fit, was, other)
    return [*_of_mounting(pose, *fits), _late_by(other)]


def _of_gyro(fit: Fit) -> tuple[list[Value], list[str]]:
    scale = _value("scale", fit, "scale", 100.0, "%")
    values = [scale, _value("bias", fit, "bias_radps", math.degrees(1.0), "deg/s"), _late_by(fit)]
    notes = []
    if scale.is_known and abs(scale.value - 100.0) > GYRO_OFF_PERCENT:
        notes.append(
            f"turns {scale.value:.0f} % of what it says: "
            + ("is it mounted upside down?" if scale.value < 0.0 else "is it level, and in rad/s?")
        )
    return values, notes


def wheel_settings(fit: Fit, wheel_base_m: float, left_scale: float, right_scale: float) -> dict[str, float]:
    """Settings by which irobot_create counts the true path; the arguments are as it was.

    With both wheels' scales s (1 - e) and s (1 + e) the distance is s times, the turn s b / b' times
    that counted, and 2 s e / b' rad a metre counted come on top.
    """
    scale, turn_scale = fit["scale"], fit["turn_scale"]
    new_base_m = wheel_base_m * scale / turn_scale
    uneven = fit["turn_per_m"] * new_base_m / (2.0 * scale)
    return {
        "wheel_base_m": round(new_base_m, 5),
        "left_scale": round(left_scale * scale * (1.0 - uneven), 5),
        "right_scale": round(right_scale * scale * (1.0 + uneven), 5),
    }


def why_not_taken(values: Mapping[str, Any], settings: Any) -> str:
    """Values that the settings of a sensor refuse, and why; "" where they accept all."""
    merged = settings.model_dump(mode="json", exclude_unset=True)
    overlay(merged, values)
    try:
        type(settings).model_validate_json(json.dumps(merged), strict=True)
    except ValidationError as error:
        return "; ".join(_words(detail) for detail in error.errors(include_url=False))
    return ""


def _words(detail: ErrorDetails) -> str:
    key, got = ".".join(map(str, detail["loc"])), detail["input"]
    if detail["type"] == "extra_forbidden":
        return f"unknown key {key}"
    why = detail["msg"].removeprefix("Value error, ").removeprefix("Input ")
    return f"{key} {got}: {why}" if isinstance(got, int | float) else f"{key} {why}".strip()


def patched(changes: Changes, config: ServiceConfig | None) -> tuple[str, str]:
    """The patch, and the complete config with it; that is empty where there is no config.

    changes   of a sensor that the config has: as why_not_taken lets them pass

    Sensors that the config does not have are left out of it.
    """
    if not changes:
        return "", "" if config is None else config.text
    patch = yaml.safe_dump({"sensors": changes}, sort_keys=False, default_flow_style=None, width=100)
    if config is None:
        return patch, ""
    editor = YAML()
    editor.preserve_quotes = True
    editor.width = 200
    document = editor.load(config.text)
    for name, values in changes.items():
        if name in document["sensors"]:
            overlay(document["sensors"][name], values)
    stream = io.StringIO()
    editor.dump(document, stream)
    parse_config(stream.getvalue(), "the calibrated config")
    return patch, stream.getvalue()
