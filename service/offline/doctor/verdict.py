"""From what a probe saw to findings: one function for each failure of a device, one for success."""

import errno
from typing import Any

from drivers.advice import DIFFERENCE
from drivers.counted import counted
from drivers.errors import DeviceError
from drivers.sensor_kind import SensorKind
from service.offline.doctor.findings import Finding, fault, note, ok
from service.offline.doctor.network import errno_of
from service.offline.doctor.probe import Probe
from service.offline.doctor.protocol_identification import (
    describe,
    is_text,
    recognise_other,
    recognise_sensor,
)

RATE_SHARE = 0.95  # of the configured rate; motors turn up to 1 % slower than stated
STAMP_AHEAD_MS = 0.5  # jitter of the estimate; more is a wrong latency setting


def streaming(kind: SensorKind, config: Any, seen: Probe) -> list[Finding]:
    """The device streams; remaining faults follow."""
    found = [_success(kind, config, seen)]
    if doubt := kind.advice.doubt(config, seen.identity) or _other_unit(config, seen):
        found.append(_fault(config, doubt, "the device that the config means"))
    if seen.error is not None:
        words = f"after {counted(seen.frames, 'frame')}: {seen.error}"
        found.append(_fault(config, words, "a steady stream"))
    elif slow := _slow_rate(kind, config, seen):
        found.append(slow)
    for part in seen.status.split("; ")[1:]:
        if DIFFERENCE in part:
            found.append(note(config.name, part, _page(config)))
        elif any(word in part for word in kind.advice.worries):
            found.append(fault(config.name, f"the device reports: {part}", "no fault", _page(config)))
    if losses := seen.losses:
        counts = ", ".join(f"{name} {count}" for name, count in losses.items())
        found.append(
            note(config.name, f"while it streamed: {counts}", f"{_page(config)} explains the counters")
        )
    if (delay := seen.delay_ms) and delay[0] < -STAMP_AHEAD_MS:
        found.append(
            fault(
                config.name,
                f"stamps lie {-delay[0]:.1f} ms after the arrival of the frame",
                "stamps before the arrival: a measurement precedes its message",
                "make its latency setting larger",
            )
        )
    return found


def _success(kind: SensorKind, config: Any, seen: Probe) -> Finding:
    rate_hz, delay = seen.arrival_rate_hz, seen.delay_ms
    parts = [f"{rate_hz:.1f} frames/s" if rate_hz else counted(seen.frames, "frame")]
    if seen.identity:
        parts.append(", ".join(f"{key} {text}" for key, text in seen.identity.items()))
    parts += seen.status.split("; ")[1:]
    values: dict[str, float | str] = {f"identity.{key}": text for key, text in seen.identity.items()}
    values |= {"frames": seen.frames, "kilobytes": round(seen.bytes_read / 1e3, 1), "status": seen.status}
    if rate_hz:
        values["rate_hz"] = round(rate_hz, 2)
    if delay:
        values |= {"delay_ms_p50": round(delay[0], 3), "delay_ms_max": round(delay[1], 3)}
        parts.append(f"stamped {delay[0]:.1f} ms before arrival, at most {delay[1]:.1f} ms")
    if seen.clock_offset_ns is not None:
        values["clock_offset_ms"] = round(seen.clock_offset_ns / 1e6, 3)
        parts.append("its clock is known")
    values |= {f"count.{name}": count for name, count in sorted(seen.counters.items())}
    return ok(config.name, f"{config.type} streams: {'; '.join(parts)}", **values)


def _slow_rate(kind: SensorKind, config: Any, seen: Probe) -> Finding | None:
    wanted_hz, rate_hz = kind.advice.rate_hz(config), seen.arrival_rate_hz
    if wanted_hz is None or (rate_hz is not None and rate_hz >= RATE_SHARE * wanted_hz):
        return None
    made_hz = seen.rate_hz
    if made_hz is not None and made_hz < RATE_SHARE * wanted_hz and not seen.losses:
        remedy = "the device is slower than the config: has another program set it, can this type do it?"
    else:
        remedy = "frames are lost in transit: look at the cable, the network's load, and this machine's"
    measured = f"{counted(seen.frames, 'frame')}, then none" if rate_hz is None else f"{rate_hz:.1f} frames/s"
    return fault(config.name, measured, f"{wanted_hz:g} frames/s as configured", remedy)


def _other_unit(config: Any, seen: Probe) -> str:
    wanted, found = getattr(config, "serial_number", None), seen.identity.get("serial")
    if wanted is None or found is None or str(wanted).casefold() == found.casefold():
        return ""
    return f"this is unit {found}, expected {wanted}; are two sensors swapped?"


def slow(config: Any, seen: Probe) -> Finding:
    """The device answers, and sends no frame in time."""
    return fault(
        config.name,
        f"{_identity(seen.reported)} answers, but no frame in {seen.seconds:.0f} s; "
        f"its status: {seen.status}",
        "the first frame by then",
        f"look again in a minute: it may be starting or taking over new settings; {_page(config)}",
    )


def refused(config: Any, seen: Probe) -> Finding:
    """The device is of the right type, and does not stream."""
    if seen.error is None:
        return fault(
            config.name,
            f"a {config.type} is there, but no frame in {seen.seconds:.0f} s; its status: {seen.status}",
            "frames",
            _page(config),
        )
    expected = "a device that takes what the config asks" if isinstance(seen.error, DeviceError) else "frames"
    return _fault(config, str(seen.error), expected)


def silent(kind: SensorKind, config: Any, seen: Probe) -> Finding:
    measured = (
        f"the wire is open, {counted(seen.bytes_written, 'byte')} sent, and nothing came "
        f"in {seen.seconds:.0f} s"
    )
    is_reset = seen.error is not None and errno_of(seen.error) in (errno.ECONNRESET, errno.EPIPE)
    if is_reset or "closed the connection" in str(seen.error):
        measured = "accepts the connection and closes it without data"
    return fault(config.name, measured, f"a {config.type} to answer", kind.advice.silence)


def other_settings(config: Any, seen: Probe, words: str, answer: Probe) -> Finding:
    return fault(
        config.name,
        f"nothing answers as configured, but with {words} a device does: {_identity(answer.identity)}",
        f"an answer with the config's own settings, within {seen.seconds:.0f} s",
        f"write {words}",
    )


def wrong_baud(config: Any, seen: Probe, baud: int, words: str) -> Finding:
    return fault(
        config.name,
        f"noise at {config.baud} baud, while {words} speaks at {baud}"
        if seen.bytes_read
        else f"silent at {config.baud} baud, while {words} speaks at {baud}",
        f"messages at {config.baud} baud, as configured",
        f"write baud: {baud}, or set the device to {config.baud}",
    )


def wrong_device(config: Any, seen: Probe, is_serial: bool) -> Finding:
    """The bytes received are not of a device of this type."""
    heard = bytes(seen.first_bytes)
    words = describe(heard)
    expected = f"messages of a {config.type}"
    if recognise_sensor(heard):
        return fault(
            config.name, f"{words} answers here", expected, "wrong `type`, or two sensors' wires are swapped"
        )
    if recognise_other(heard) or is_text(heard) or not is_serial:
        where = "device" if is_serial else "host and port"
        return fault(config.name, f"wrong protocol: {words}", expected, f"is {where} right? {_page(config)}")
    baud = getattr(config, "baud", None)
    at = f"at {baud} baud " if baud else ""
    return fault(
        config.name,
        f"{at}only noise comes: {words}",
        expected,
        f"is it the right port, is baud right, do levels (RS-232, TTL) and ground fit? {_page(config)}",
    )


def _fault(config: Any, words: str, expected: str) -> Finding:
    """words    what a driver says: what is wrong; what to do"""
    measured, _, remedy = words.partition("; ")
    return fault(config.name, measured, expected, remedy or _page(config))


def _identity(identity: dict[str, str]) -> str:
    return ", ".join(f"{key} {text}" for key, text in identity.items()) or "it"


def _page(config: Any) -> str:
    return f"docs/devices/{config.type}.md"
