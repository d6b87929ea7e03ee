"""Identifies the device or program that sent these bytes, for a user who expected another one."""

import re
from collections import Counter
from math import log2

from drivers.counted import counted
from service.sensor_kinds import SENSOR_KINDS

SHOWN_BYTES = 16
SHOWN_CHARS = 48
TEXT_SHARE = 0.85

_OTHERS = (
    (rb"HTTP/\d\.\d \d{3}[^\r\n]{0,40}", "a web server"),
    (rb"(?i)^\s*<!doctype html|^\s*<html", "a web server"),
    (rb"^SSH-[\d.]+-[^\r\n]{0,40}", "an SSH server"),
    (rb"^220[ -][^\r\n]{0,40}", "an FTP or mail server"),
    (rb"^\xff[\xfb-\xfe].", "a telnet server"),
    (rb"^[\x14-\x17]\x03[\x00-\x04]", "a server that wants TLS"),
    (rb"^RFB \d{3}\.\d{3}", "a VNC server"),
    (rb"\$G[NPLABQ][A-Z]{3},[^\r\n]{0,40}", "a GNSS receiver (NMEA sentences)"),
    (rb"U-Boot|Linux version|login: ?$", "the console of an embedded computer"),
    (rb"^AT(?:E1|Q0|\+CGMI|\+GCAP)?\r", "a program that takes this port for a modem's (ModemManager does)"),
)


def recognise_sensor(data: bytes, kind: str = "") -> str:
    """The type of sensor whose protocol this is, as text; `kind` restricts it to one type."""
    for name, sensor in SENSOR_KINDS.items():
        if kind in ("", name) and (words := sensor.advice.recognise(data)):
            return words
    return ""


def recognise_other(data: bytes) -> str:
    """A known program or device that is no sensor of ours, with the text it sent; "" where it is unknown."""
    for pattern, words in _OTHERS:
        if found := re.search(pattern, data):
            shown = _shown(found.group())
            return f'{words} ("{shown}")' if shown else words
    return ""


def describe(data: bytes) -> str:
    """The first bytes as text; `data` is not empty."""
    known = recognise_sensor(data) or recognise_other(data)
    if known:
        return known
    if is_text(data):
        return f'text that begins "{_shown(data)}"'
    start = data[:SHOWN_BYTES].hex(" ")
    return f"{counted(len(data), 'byte')}, beginning {start}, {_texture(data)}"


def is_text(data: bytes) -> bool:
    plain = sum(byte in (9, 10, 13) or 32 <= byte < 127 for byte in data)
    return plain >= TEXT_SHARE * len(data)


def _texture(data: bytes) -> str:
    """Distribution of the bytes: a line read at the wrong rate has few values, mostly 00, ff, 80, f8, fe."""
    counts = Counter(data)
    bits = -sum(n / len(data) * log2(n / len(data)) for n in counts.values())
    if len(counts) == 1:
        return "all the same"
    edges = sum(counts[byte] for byte in (0x00, 0x80, 0xC0, 0xE0, 0xF0, 0xF8, 0xFC, 0xFE, 0xFF))
    if edges > len(data) / 2:
        return "as a serial line reads at the wrong baud rate"
    return f"no message of any sensor known here ({bits:.1f} bits of variety a byte)"


def _shown(data: bytes) -> str:
    text = data.decode("ascii", "replace").strip()
    return "".join(char if char.isprintable() else " " for char in text)[:SHOWN_CHARS].strip()
