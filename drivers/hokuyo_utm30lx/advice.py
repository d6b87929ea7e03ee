"""Hints on Hokuyo lasers for `corridor doctor`: protocol, product names, causes of silence."""

from collections.abc import Mapping
from typing import Any

from drivers.advice import Advice
from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.hokuyo_utm30lx.models import model_of
from drivers.hokuyo_utm30lx.protocol import ReplyDecoder


def rate_hz(config: HokuyoUtm30lxConfig) -> float:
    return config.limits.rate_hz / (1 + config.skip_scans)


def recognise(data: bytes) -> str:
    replies = ReplyDecoder().receive_data(data)
    return "a Hokuyo laser that speaks SCIP" if replies else ""


def doubt(config: HokuyoUtm30lxConfig, identity: Mapping[str, str]) -> str:
    """PROD of the USB unit ends in UTM-30LX, that of the Ethernet unit is UTM-30LX-EW."""
    product = identity.get("product", "")
    if not product or model_of(product) == config.model:
        return ""
    where = config.device or config.host
    return f"it calls itself {product}, expected a {config.limits.name}; is {where} the right laser?"


def settings_of(identity: Mapping[str, str]) -> dict[str, Any]:
    model = model_of(identity.get("product", ""))
    return {"model": model} if model else {}


ADVICE = Advice(
    name="utm",
    at_host={},
    at_port={},
    rate_hz=rate_hz,
    recognise=recognise,
    doubt=doubt,
    settings_of=settings_of,
    worries=("stopped", "fault", "Trouble", "error", "Error", "nstable"),
    start_up_s=15.0,
    silence="just switched on it needs some seconds; does it have 12 V and 1 A, does its lamp blink? another "
    "program may hold it: ModemManager opens every /dev/ttyACM*, an Ethernet unit takes one client alone",
)
