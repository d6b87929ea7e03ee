"""Hints on Xsens units for `corridor doctor`: framing, baud rates, causes of silence."""

from collections.abc import Mapping

from drivers.advice import Advice, OtherSettings
from drivers.xsens_mtig.config import AUTO, XsensMtigConfig
from drivers.xsens_mtig.protocol import LIKELY_BAUDS, MessageDecoder, Mid
from drivers.xsens_mtig.wanted import has_receiver

MADE_BY_XSENS = {Mid.MTDATA: "MTData (an MTi-G)", Mid.MTDATA2: "MTData2 (an MTi-G-700 or later)"}


def rate_hz(config: XsensMtigConfig) -> float:
    """Samples and fixes together."""
    return float(config.rate_hz) + (4.0 if config.gnss else 0.0)


def recognise(data: bytes) -> str:
    mids = {message.mid for message in MessageDecoder().receive_data(data)}
    spoken = next((words for mid, words in MADE_BY_XSENS.items() if mid in mids), "")
    if spoken:
        return f"an Xsens unit that sends {spoken}"
    return "an Xsens unit" if mids else ""


def other_settings(config: XsensMtigConfig) -> list[OtherSettings]:
    if config.over_usb or config.baud == AUTO:
        return []
    return [OtherSettings("baud: auto", config.model_copy(update={"baud": AUTO}))]


def doubt(config: XsensMtigConfig, identity: Mapping[str, str]) -> str:
    product = identity.get("product", "")
    if not config.gnss or has_receiver(product):
        return ""
    return (
        f"it calls itself {product}, which has no GNSS receiver; write gnss: false, or is it the wrong unit?"
    )


ADVICE = Advice(
    name="imu",
    at_port={"baud": 115_200},
    rate_hz=rate_hz,
    recognise=recognise,
    bauds=LIKELY_BAUDS,
    other_settings=other_settings,
    doubt=doubt,
    worries=("self-test failed", "error 0x", "warning ", "does not send", "filter not settled"),
    start_up_s=12.0,  # two rounds of all baud rates; a unit that ignores GoToConfig is reset in less
    silence="is it powered (USB does, some serial cables do not), is this its port? "
    "ModemManager holds new serial ports for some seconds",
)
