"""What is written and read by struct calls is what the type store of rosbags writes and reads."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from drivers.frames import Frame, ImuSample, OdometrySample
from service.encoding import decode_frame, encode_frame, quick, wire
from service.errors import InputError
from service.geometry.se2 import SE2
from service.outputs import NO_REASON, MapperOutput

STAMP_NS = 1_700_000_001_987_654_321
NAMES = ["i", "im", "imu", "base", "front", "übung", "a_long_name"]  # of every alignment


def imu(sensor: str, is_oriented: bool = True) -> ImuSample:
    orientation = (0.5, -0.5, 0.1, 0.7) if is_oriented else None
    return ImuSample(sensor, STAMP_NS, STAMP_NS, (0.1, -0.2, math.pi), (1e-3, 9.81, -3.0), orientation)


def odometry(sensor: str) -> OdometrySample:
    covariance = (0.1, 0.02, 0.03, 0.02, 0.5, 0.06, 0.03, 0.06, 0.9)
    return OdometrySample(sensor, STAMP_NS, STAMP_NS, 1.25, -7.5, 2.0, (0.3, 0.01, -0.2), covariance)


def output() -> MapperOutput:
    covariance = np.array([[0.1, 0.02, 0.03], [0.02, 0.5, 0.06], [0.03, 0.06, 0.9]])
    poses = SE2(1.0, -2.0, 0.3), SE2(0.5, 0.25, -3.0)
    return MapperOutput(STAMP_NS, *poses, (0.3, 0.01, -0.2), covariance, "ok", NO_REASON, 0.9)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("make", [imu, odometry, lambda sensor: imu(sensor, is_oriented=False)])
def test_a_sample_is_read_as_by_the_type_store(
    name: str, make: Callable[[str], Frame], monkeypatch: pytest.MonkeyPatch
):
    message = encode_frame(make(name), 0, STAMP_NS)
    read = {wire.IMU: quick.read_imu, wire.ODOMETRY: quick.read_odometry}[message.type]
    assert (read(message.payload) is None) == (not name.isascii())
    frame = decode_frame(message.type, message.payload, name, STAMP_NS)
    monkeypatch.setattr(quick, "read_imu", lambda payload: None)
    monkeypatch.setattr(quick, "read_odometry", lambda payload: None)
    assert frame == decode_frame(message.type, message.payload, name, STAMP_NS)
    assert frame is not None


@pytest.mark.parametrize("make", [imu, odometry])
def test_what_is_laid_out_otherwise_is_left_to_the_type_store(make: Callable[[str], Frame]):
    message = encode_frame(make("base"), 0, STAMP_NS)
    store = wire.store()
    content = store.deserialize_cdr(message.payload, message.type)
    big_endian = bytes(store.serialize_cdr(content, message.type, little_endian=False))
    assert quick.read_imu(big_endian) is None
    assert quick.read_odometry(big_endian) is None
    assert decode_frame(message.type, big_endian, "base", STAMP_NS) == decode_frame(
        message.type, message.payload, "base", STAMP_NS
    )
    for size in (0, 3, 4, 12, 15, 18, len(message.payload) - 1):
        with pytest.raises(InputError):
            decode_frame(message.type, message.payload[:size], "base", STAMP_NS)
