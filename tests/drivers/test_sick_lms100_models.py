"""Scanners that share the LMS1xx's telegram: real telegrams, the driver against a fake of each, refusals."""

import math
from pathlib import Path

import numpy as np
import pytest

from drivers.sick_lms100.driver import Lms100Session
from drivers.sick_lms100.models import MODELS, mismatch
from drivers.sick_lms100.protocol import Decoder, Dialect, encode
from drivers.sick_lms100.telegrams import read_scan, write_scan
from simulators.sick_setup import Lms100Setup
from tests.drivers.lms100 import config, talk, telegram
from tests.drivers.virtual_time import SECOND_NS

TELEGRAMS = Path(__file__).parent / "telegrams"
OTHERS = ("lms5xx", "tim5xx", "tim7xx")


def recorded(name):
    """Bytes of one telegram of a real device."""
    path = next(TELEGRAMS.glob(f"{name}.*"))
    text = path.read_text()
    return bytes.fromhex(text) if path.suffix == ".hex" else b"\x02" + text.strip().encode() + b"\x03"


@pytest.mark.parametrize(
    ("name", "model", "rate_hz", "step_deg", "beams", "first_deg", "shots_khz", "ranges_m", "intensity"),
    [
        ("lms511", "lms5xx", 25, 1 / 6, 1141, -95.0, 54.0, (1.305, 0.624), (254, 208)),
        ("tim551", "tim5xx", 15, 1.0, 271, -135.0, 5.4, (0.44, 1.333), (170, 163)),
        ("tim781s", "tim7xx", 15, 1 / 3, 811, -135.0, 16.2, (1.356, 0.662), (10_421, 14_131)),
    ],
)
def test_recorded_scan_becomes_a_frame(
    name, model, rate_hz, step_deg, beams, first_deg, shots_khz, ranges_m, intensity
):
    changes = {"scan_rate_hz": rate_hz, "angle_step_deg": round(step_deg, 4), "intensity_bits": 8}
    session = Lms100Session(config(model=model, **changes))
    [frame] = session.receive_data(recorded(name), 1_000 * SECOND_NS)
    assert len(frame.range_m) == len(frame.intensity) == beams
    assert frame.scan_period_ns == round(1e9 / rate_hz)
    assert frame.beam_interval_ns == pytest.approx(1e6 / shots_khz, abs=1.0)
    assert frame.first_angle_rad == pytest.approx(math.radians(first_deg), abs=1e-9)
    last_rad = frame.first_angle_rad + (beams - 1) * frame.angle_step_rad
    assert last_rad == pytest.approx(-frame.first_angle_rad, abs=1e-9)  # though 0.1667 deg is sent
    assert tuple(frame.range_m[[0, -1]].tolist()) == pytest.approx(ranges_m)
    assert tuple(frame.intensity[[0, -1]].tolist()) == intensity


@pytest.mark.parametrize(
    ("name", "last_e4deg"), [("lms511", 1_850_000), ("tim551", 2_250_000), ("tim781s", 2_250_000)]
)
def test_recorded_telegram_is_written_as_it_was_read(name, last_e4deg):
    raw = recorded(name)
    [read] = Decoder().receive_data(raw)
    scan = read_scan(read)
    assert scan.channel("DIST1").last_e4deg == last_e4deg  # though its step is stated rounded
    assert encode(write_scan(scan, read.dialect)) == raw


@pytest.mark.parametrize(("name", "model"), [("tim551", "tim5xx"), ("tim781s", "tim7xx")])
def test_tim_stamps_its_scan_after_the_sweep(name, model):
    """Sent 3.8 and 7.7 ms after the zero index: the first beam was a sweep of 50 ms before the sending."""
    session = Lms100Session(config(model=model))
    [frame] = session.receive_data(recorded(name), 1_000 * SECOND_NS)
    assert frame.stamp_ns == pytest.approx(1_000 * SECOND_NS - 50_000_000, abs=20_000)


def test_lms5xx_stamps_its_scan_before_the_sweep():
    session = Lms100Session(config(model="lms5xx"))
    [frame] = session.receive_data(recorded("lms511"), 1_000 * SECOND_NS)
    assert frame.stamp_ns == 1_000 * SECOND_NS - 40_853_000


@pytest.mark.parametrize("configured", MODELS)
def test_scale_of_the_telegram_counts_whatever_model_is_configured(configured):
    """An OEM's name is no model's; 2 mm per digit is what SOPAS ET sets in an LMS5xx for 80 m."""
    setup = Lms100Setup("lms5xx", "something of an OEM", scale=2.0)
    t = talk(setup, model=configured).run(10.0)
    assert np.nanmax(t.frames[-1].range_m) == np.float32(3.0)


@pytest.mark.parametrize("dialect", list(Dialect))
@pytest.mark.parametrize("model", OTHERS)
def test_driver_streams_from_the_fake_of_each_model(model, dialect):
    limits = MODELS[model]
    t = talk(Lms100Setup(model=model, dialect=dialect), model=model, intensity_bits=16).run(2.0)
    assert t.session.status == "streaming"
    frame = t.frames[-1]
    first_deg, last_deg = limits.field_of_view_deg
    assert math.degrees(frame.first_angle_rad) == pytest.approx(first_deg)
    last_rad = frame.first_angle_rad + (len(frame.range_m) - 1) * frame.angle_step_rad
    assert math.degrees(last_rad) == pytest.approx(last_deg)
    assert frame.scan_period_ns == round(1e9 / limits.rates_hz[0])
    assert frame.range_max_m == limits.range_max_m
    assert np.nanmax(frame.range_m) == np.float32(3.0)
    assert t.session.counters["scans_not_as_configured"] == 0
    begins_ns = {first_ns for first_ns in t.room.first_rays_ns}
    late_ns = min(abs(frame.stamp_ns - first_ns) for first_ns in begins_ns)
    assert late_ns < 700_000  # what is not known of the time from the last beam to the sending


def written(t):
    """Names of what the session wrote, in order."""
    return [r.name for r in Decoder().receive_data(bytes(t.sent)) if r.kind in ("sWN", "sMN")]


@pytest.mark.parametrize(("stored", "echo", "wanted"), [(1, "first", 0), (0, "last", 2), (2, "first", 0)])
def test_lms5xx_chooses_its_echo_by_the_filter(stored, echo, wanted):
    t = talk(Lms100Setup(model="lms5xx", echo_filter=stored), model="lms5xx", echo=echo).run(3.0)
    assert t.session.status == "streaming"
    assert "FREchoFilter" in written(t)
    assert "LMDscandatacfg" not in written(t)
    assert t.device.echo_filter == wanted


MRS1104_IDENT = bytes.fromhex(  # SICKAG/sick_scan_xd, 20210722_143600_ros2_mrs1104_sick_scan_xd.pcapng.json
    "0202020200000024735241204465766963654964656e742000084d525331787878780008312e302e302e30520a"
)


def test_recorded_name_of_an_mrs1104_is_refused():
    [answer] = Decoder().receive_data(MRS1104_IDENT)
    assert answer.body[2:10] == b"MRS1xxxx"
    assert "MRS1000" in mismatch("MRS1xxxx", "lms1xx")


def test_scan_with_more_beams_than_the_model_has_is_malformed():
    """As of an MRS1104 that does not answer DeviceIdent: 1101 beams."""
    session = Lms100Session(config(model="tim5xx"))
    session.receive_data(encode(write_scan(telegram(values=(1500,) * 1101), Dialect.ASCII)), SECOND_NS)
    assert session.counters["scans_malformed"] == 1
