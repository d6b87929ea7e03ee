"""Hints on the LUX for `corridor doctor`: other devices of its protocol, and faults in a status."""

from drivers.advice import Advice
from drivers.errors import ProtocolError
from drivers.ibeo_lux.config import IbeoLuxConfig
from drivers.ibeo_lux.protocol import FOREIGN_SCANS, Decoder


def rate_hz(config: IbeoLuxConfig) -> float:
    return config.scan_rate_hz if config.mirror_sides == "both" else config.scan_rate_hz / 2.0


def recognise(data: bytes) -> str:
    try:
        messages = Decoder().receive_data(data)
    except ProtocolError:
        return ""
    if not messages:
        return ""
    foreign = [FOREIGN_SCANS[message.data_type] for message in messages if message.data_type in FOREIGN_SCANS]
    return foreign[0] if foreign else "an IBEO LUX or a SICK LD-MRS"


ADVICE = Advice(
    name="lux",
    at_host={},
    rate_hz=rate_hz,
    recognise=recognise,
    worries=(
        *("error:", "warning:", "motor off", "laser off", "scan frequency not reached"),
        *("no external synchronisation", "stand still"),
    ),
    start_up_s=20.0,  # the mirror needs seconds to come up to speed
    silence="just switched on it needs some seconds; is port 12002 held by another host, Ibeo's or SICK's "
    "own program say?",
)
