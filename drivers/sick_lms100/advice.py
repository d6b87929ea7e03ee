"""Hints on SICK scanners for `corridor doctor`: their dialects, ports and families."""

from collections.abc import Mapping
from typing import Any

from drivers.advice import Advice, OtherSettings
from drivers.errors import ProtocolError
from drivers.sick_lms100.config import Lms100Config
from drivers.sick_lms100.models import model_of
from drivers.sick_lms100.protocol import Decoder

PORTS = (2111, 2112)
DIALECT_SETTINGS = {"cola_a": "cola_b", "cola_b": "cola_a"}


def rate_hz(config: Lms100Config) -> float:
    return float(config.scan_rate_hz)


def recognise(data: bytes) -> str:
    try:
        telegrams = Decoder().receive_data(data)
    except ProtocolError:
        return ""
    return f"a SICK scanner that speaks {telegrams[0].dialect.value}" if telegrams else ""


def other_settings(config: Lms100Config) -> list[OtherSettings]:
    """The other dialect first: a device that is set to it answers nothing at all in this one."""
    found = []
    if config.dialect in DIALECT_SETTINGS:
        dialect = DIALECT_SETTINGS[config.dialect]
        found.append(OtherSettings(f"dialect: {dialect}", config.model_copy(update={"dialect": dialect})))
    if config.port in PORTS:
        port = PORTS[1 - PORTS.index(config.port)]
        changed = config.model_copy(update={"port": port, "dialect": "auto"})
        found.append(OtherSettings(f"port: {port}", changed))
    return found


def doubt(config: Lms100Config, identity: Mapping[str, str]) -> str:
    """DeviceIdent begins with the family's name, as in `LMS10x_FieldEval V1.36`."""
    device = identity.get("device", "")
    if not device or model_of(device) == config.model:
        return ""
    return (
        f"it calls itself {device}, expected {config.limits.name}; is host {config.host} the right scanner?"
    )


def settings_of(identity: Mapping[str, str]) -> dict[str, Any]:
    model = model_of(identity.get("device", ""))
    return {"model": model} if model else {}


ADVICE = Advice(
    name="lms",
    at_host={},
    rate_hz=rate_hz,
    recognise=recognise,
    other_settings=other_settings,
    doubt=doubt,
    settings_of=settings_of,
    worries=("contamination", "device error", "temperature", "state "),
    start_up_s=20.0,  # 50 Hz and 25 Hz need another angle step; half a minute is reported, not waited for
    silence="just switched on it needs half a minute, after a lost connection up to one; is another host, "
    "SOPAS ET say, on this port? cut its power once, then look again",
)
