"""The config of every sensor: the example says the defaults; what a device cannot do is refused in words."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.irobot_create.config import IrobotCreateConfig
from drivers.registry import SENSOR_KINDS
from drivers.sensor_section import MAX_LATENCY_MS, MIN_LATENCY_MS
from drivers.sick_lms100.config import Lms100Config
from drivers.xsens_mtig.config import XsensMtigConfig
from service.mapper.pipeline import MAX_BEHIND_NS

EXAMPLES = Path(__file__).parents[2] / "config/sensors"
LMS, UTM, LUX, MTIG, CREATE = "sick_lms100", "hokuyo_utm30lx", "ibeo_lux", "xsens_mtig", "irobot_create"
HOST, PORT = {"host": "192.168.0.10"}, {"device": "/dev/ttyUSB0"}
WIRES: dict[str, dict[str, Any]] = {LMS: HOST, UTM: PORT, LUX: HOST, MTIG: PORT, CREATE: PORT}
UST = {"device": None, **HOST, "model": "ust"}
URG = {"model": "urg_04lx_ug01"}


def config(kind: str, **changes: Any) -> Any:
    return SENSOR_KINDS[kind].config.model_validate({"name": "x"} | WIRES[kind] | changes)


@pytest.mark.parametrize("kind", WIRES)
def test_the_example_says_every_default(kind: str):
    example = yaml.safe_load((EXAMPLES / f"{kind}.yaml").read_text())
    wire = {key: example[key] for key in WIRES[kind]}
    assert config(kind, **example) == config(kind, **wire)


@pytest.mark.parametrize(
    ("kind", "changes", "words"),
    [
        *((kind, {"hots": "1.2.3.4"}, "hots") for kind in WIRES),
        *((kind, {"mounting": {"x": 1.0}}, "mounting") for kind in WIRES),
        *((kind, {"latency_ms": MIN_LATENCY_MS - 1.0}, "greater than or equal to -50") for kind in WIRES),
        *((kind, {"latency_ms": MAX_LATENCY_MS + 1.0}, "less than or equal to 200") for kind in WIRES),
        *((kind, {"range_min_m": 3.0, "range_max_m": 2.0}, "must be below") for kind in (LMS, UTM, LUX)),
        *((kind, {"first_angle_deg": 10.0, "last_angle_deg": 10.0}, "lie below") for kind in (LMS, UTM)),
        (LMS, {"scan_rate_hz": 100}, "must be 25 or 50, not 100"),
        (LMS, {"angle_step_deg": 0.25}, "needs scan_rate_hz 25"),
        (LMS, {"angle_step_deg": 0.1, "scan_rate_hz": 25}, "must be 0.25 or 0.5"),
        (LMS, {"password_hash": "main"}, "password_hash"),
        (LMS, {"model": "mrs1000"}, "lms1xx"),
        (LMS, {"model": ["lms5xx"]}, "lms1xx"),
        (LMS, {"model": "lms5xx", "scan_rate_hz": 15}, "must be 25 or 35 or 50 or 75 or 100, not 15"),
        (LMS, {"model": "lms5xx", "angle_step_deg": 0.25}, "needs scan_rate_hz 35 or less, not 50"),
        (LMS, {"model": "lms5xx", "first_angle_deg": -100.0}, "must lie within -95 to 95"),
        (LMS, {"model": "tim7xx", "angle_step_deg": 1.0}, "must be 0.3333, not 1"),
        (LMS, {"model": "tim7xx", "echo": "last"}, "model tim7xx has no echo last; write echo: first"),
        (UTM, {"device": None}, "either device"),
        (UTM, HOST, "not both"),
        (UTM, {"echo": "last"}, "needs a UTM-30LX-EW"),
        (UTM, {"cluster": 100}, "cluster"),
        (UTM, {"model": "utm_x002"}, "utm_30lx"),
        (UTM, {"model": "ust"}, "model ust has no device; give host"),
        (UTM, {"device": None, **HOST, **URG}, "model urg_04lx_ug01 has no host; give device"),
        (UTM, {**URG, "intensity": True}, "sends no intensity"),
        (UTM, {**UST, "echo": "last"}, "model ust has no echo last; write echo: first"),
        (LUX, {"scan_rate_hz": 40}, "must be 12.5, 25 or 50, not 40"),
        (LUX, {"angle_step_deg": 0.1}, "must be 0.125, 0.25 or 0.5"),
        (LUX, {"first_angle_deg": -10.0, "last_angle_deg": 10.0}, "sweeps from left to right"),
        (LUX, {"layers": [1, 1]}, "names one twice"),
        (CREATE, {"baud": 9600}, "too slow for a frame every 15 ms"),
        (CREATE, {"baud": 115_201}, "none of the robot's rates"),
        (CREATE, {"model": "create3"}, "'create1', 'create2' or 'roomba'"),
        (CREATE, {"model": "create1", "wheel_diameter_m": 0.078}, "means nothing to a create1"),
        (CREATE, {"model": "create1", "counts_per_revolution": 508.8}, "right_scale and wheel_base_m"),
        (MTIG, {"baud": 100_000}, "baud 100000 is none of the device's rates"),
        (MTIG, {"baud": 115_200, "store_baud": 460_800}, "unheard at baud 115200; write baud: auto"),
        (MTIG, {"device": "usb", "baud": 115_200}, "device usb has no baud rate"),
        (MTIG, {"device": "usb:0380", "store_baud": 115_200}, "has no baud rate"),
        (MTIG, {"forward_axis": "x", "up_axis": "-x"}, "same axis"),
        (MTIG, {"lever_arm_m": [350.0, 0.0, 0.0]}, "lever_arm_m .* in metres"),
        (MTIG, {"rate_hz": 150}, "rate_hz"),
    ],
)
def test_what_a_device_cannot_do_is_refused_in_words(kind: str, changes: dict[str, Any], words: str):
    with pytest.raises(ValidationError, match=words):
        config(kind, **changes)


@pytest.mark.parametrize(
    ("changes", "command"),
    [
        ({}, "MD"),
        ({"intensity": True}, "ME"),
        ({"device": None, **HOST}, "MD"),
        ({"device": None, **HOST, "echo": "last"}, "ND"),
        ({"device": None, **HOST, "echo": "last", "intensity": True}, "NE"),
        ({"device": None, **HOST, "echo": "strongest"}, "NE"),
    ],
)
def test_utm30lx_is_asked_for_what_is_wanted_and_no_more(changes: dict[str, Any], command: str):
    utm: HokuyoUtm30lxConfig = config(UTM, **changes)
    assert utm.scan_command == command


def test_a_scan_of_the_greatest_latency_is_mapped():
    slowest_sweep_ms = 80.0  # of a LUX at 12.5 Hz
    assert (MAX_LATENCY_MS + slowest_sweep_ms) * 1e6 <= MAX_BEHIND_NS


def test_lux_takes_even_ticks():
    odd = config(LUX, first_angle_deg=10.03, last_angle_deg=-10.03)  # 320.96 and -320.96 ticks
    assert (odd.first_ticks, odd.last_ticks) == (320, -320)


def test_lms5xx_takes_rate_and_step_that_an_lms1xx_does_not():
    lms: Lms100Config = config(LMS, model="lms5xx", scan_rate_hz=100, angle_step_deg=0.6667)
    assert (lms.scan_rate_hz, lms.angle_step_deg) == (100, 0.6667)


def test_usb_is_named_with_or_without_a_serial_number():
    usb: XsensMtigConfig = config(MTIG, device="usb")
    assert (usb.over_usb, usb.usb_serial) == (True, None)
    assert config(MTIG, device="usb:03800123").usb_serial == "03800123"
    assert not config(MTIG).over_usb


def test_models_of_create_bring_geometry_and_baud_and_measured_values_override_them():
    create2: IrobotCreateConfig = config(CREATE)
    create1: IrobotCreateConfig = config(CREATE, model="create1", wheel_base_m=0.26)
    assert (create2.baud, create2.wheel_base_m) == (115_200, 0.235)
    assert create2.left_m_per_count == pytest.approx(0.444565e-3, abs=1e-9)  # the manual's figure
    assert (create1.baud, create1.wheel_base_m, create1.firmware_wheel_base_m) == (57_600, 0.26, 0.258)
    scaled = config(CREATE, wheel_diameter_m=0.036, left_scale=1.01)
    assert scaled.left_m_per_count == pytest.approx(0.505 * create2.left_m_per_count)
    assert scaled.right_m_per_count == pytest.approx(0.5 * create2.right_m_per_count)
