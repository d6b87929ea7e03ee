"""Hokuyo lasers beside the UTM-30LX: real replies, the driver against a fake of each, refusals."""

import math
from pathlib import Path

import numpy as np
import pytest

from drivers.hokuyo_utm30lx.advice import ADVICE
from drivers.hokuyo_utm30lx.models import MODELS, model_of
from drivers.hokuyo_utm30lx.protocol import ReplyDecoder, encode_info, read_info
from drivers.hokuyo_utm30lx.scans import read_scan, write_scan
from simulators.hokuyo_setup import Utm30lxSetup
from tests.drivers.utm30lx import config, talk

UST = {"model": "ust", "host": "192.168.0.10"}
URG = {"model": "urg_04lx_ug01"}
RECORDED = (Path(__file__).parent / "telegrams/urg_04lx_ug01.scip").read_bytes()


def ust(**changes):
    return Utm30lxSetup(wire="ethernet", model="ust", **changes)


def urg(**changes):
    return Utm30lxSetup(model="urg_04lx_ug01", **changes)


def test_recorded_scan_of_a_urg_is_read_and_written_as_it_came():
    [reply] = ReplyDecoder().receive_data(RECORDED)
    scan = read_scan(reply)
    assert scan.distance_mm.shape == (1, 682)
    assert scan.distance_mm[0, 18:21].tolist() == [3505, 3351, 3505]  # "0fa0dG0fa"
    assert np.unique(scan.distance_mm[scan.distance_mm < 20]).tolist() == [0, 6, 7]
    assert write_scan(scan, status=reply.status) == RECORDED


def test_recorded_identity_of_a_urg_is_read():
    lines = (
        b"VEND:Hokuyo Automatic Co.,Ltd.;[\nPROD:SOKUIKI Sensor URG-04LX-UG01(Simple-URG);[\n"
        b"FIRM:3.4.03(17/Dec./2012);T\nPROT:SCIP 2.0;N\nSERI:H1510998;V\n"
    )
    [reply] = ReplyDecoder().receive_data(b"VV\n00P\n" + lines + b"\n")
    identity = read_info(reply)
    assert model_of(identity["PROD"]) == "urg_04lx_ug01"
    assert encode_info("VV", list(identity.items())) == b"VV\n00P\n" + lines + b"\n"


@pytest.mark.parametrize(
    ("setup", "changes", "rate_hz", "first_deg", "last_deg", "beams", "no_return"),
    [
        (ust(), UST, 40, -135.0, 135.0, 1081, "beams_beyond_range"),
        (urg(), URG, 10, -340 * 360 / 1024, 341 * 360 / 1024, 682, "beams_no_return"),
    ],
)
def test_driver_streams_from_the_fake_of_each_model(
    setup, changes, rate_hz, first_deg, last_deg, beams, no_return
):
    t = talk(setup, **changes).run(6.0)
    assert t.session.status == "streaming"
    frame = t.frames[-1]
    assert len(frame.range_m) == beams
    assert math.degrees(frame.first_angle_rad) == pytest.approx(first_deg)
    last_rad = frame.first_angle_rad + (beams - 1) * frame.angle_step_rad
    assert math.degrees(last_rad) == pytest.approx(last_deg)
    assert frame.scan_period_ns == pytest.approx(1e9 / rate_hz, rel=1e-3)
    seen = np.delete(np.arange(beams), np.s_[::10])
    np.testing.assert_array_equal(frame.range_m[seen], np.float32(1.0 + seen * 1e-3))
    assert np.isnan(frame.range_m[::10]).all()
    assert t.session.counters[no_return] == len(range(0, beams, 10)) * len(t.frames)
    assert frame.range_max_m == MODELS[changes["model"]].range_max_m
    late_ns = min(abs(frame.stamp_ns - first_ns) for first_ns in t.room.first_rays_ns)
    assert late_ns < 1_000_000
    assert ADVICE.rate_hz(config(**changes)) == rate_hz


def test_urg_that_locks_up_at_intensities_is_never_asked_for_them():
    t = talk(urg(), **URG).run(3.0)
    assert b"ME" not in t.sent
    assert t.device.receive_data(b"ME0044072501000\n", t.now_ns) == b""
    assert t.device.receive_data(b"VV\n", t.now_ns) == b""  # until its power is cut
