import json
import math
import struct

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, LaserScan
from service.encoding import Pose
from service.geometry.se2 import SE2
from service.web.protocol import (
    RANGE_STEP_M,
    CommandRequest,
    RequestError,
    TokenShown,
    encode_scan,
    pose_json,
    read_request,
    to_json,
)


def scan(ranges: list[float]) -> LaserScan:
    return LaserScan(
        "vörne", 1_500_000_000, 2_000_000_000, 25_000, 20_000_000, -1.5, 0.25, 0.1, 400.0,
        np.array(ranges, np.float32), NO_INTENSITY,
    )  # fmt: skip


def test_ranges_come_back_to_half_a_step_and_no_return_as_zero():
    payload = encode_scan(scan([1.0, math.nan, 0.004, 326.3, 328.0, math.inf]))
    kind, name_bytes, beams = struct.unpack_from("<BBH", payload)
    stamp_s, first, step, interval_s = struct.unpack_from("<dfff", payload, 4)
    assert (kind, beams, stamp_s, first, step) == (2, 6, 1.5, -1.5, 0.25)
    assert interval_s == pytest.approx(25e-6)
    assert payload[24 : 24 + name_bytes].decode() == "vörne"
    steps = np.frombuffer(payload, "<u2", offset=24 + name_bytes)
    assert steps.tolist() == [200, 0, 1, 65260, 0, 0]
    assert steps[3] * RANGE_STEP_M == pytest.approx(326.3, abs=RANGE_STEP_M / 2)


def test_a_pose_keeps_every_digit_of_its_stamp():
    stamp_ns = 1_700_000_000_123_456_789
    pose = Pose(stamp_ns, "map", "base_link", SE2(1.0, 2.0, 0.5), np.eye(3), (1.0, 0.0, 0.1))
    facts = json.loads(pose_json(pose))
    assert (facts["stamp_ns"], facts["x_m"], facts["theta_rad"]) == (str(stamp_ns), 1.0, 0.5)
    assert facts["covariance"] == np.eye(3).ravel().tolist()
    assert facts["twist"] == [1.0, 0.0, 0.1]


def test_what_is_not_finite_becomes_null():
    facts = json.loads(to_json("x", a=math.nan, b=[math.inf, 1.0], c={"d": -math.inf}))
    assert facts == {"type": "x", "a": None, "b": [None, 1.0], "c": {"d": None}}


def test_requests_are_read():
    assert read_request('{"type": "token", "token": "abc"}') == TokenShown(type="token", token="abc")
    command = read_request('{"type": "command", "n": 3, "verb": "mark", "request": {"text": "x"}}')
    assert command == CommandRequest(type="command", n=3, verb="mark", request={"text": "x"})
    look = read_request(
        '{"type": "resource", "n": 1, "action": "keyframe", "name": "a", "request": {"keyframe": 3}}'
    )
    assert (look.action, look.name, look.request) == ("keyframe", "a", {"keyframe": 3})


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        '{"type": "shell"}',
        '{"type": "token", "token": 5}',
        '{"type": "token", "token": "' + "x" * 201 + '"}',
        '{"type": "command", "n": -1, "verb": "mark"}',
        '{"type": "command", "n": 1e400, "verb": "mark"}',
        '{"type": "command", "n": 1, "verb": "' + "m" * 41 + '"}',
        '{"type": "command", "n": 1, "verb": "mark", "request": []}',
        '{"type": "command", "n": 1, "verb": "mark", "more": 1}',
        "[" * 50_000,
        '{"type": "resource", "n": 1, "action": "keyframe", "request": []}',
        '{"type": "resource", "n": 1, "action": "edit", "request": {}}',
        '{"type": "resource", "n": 1, "action": "buy"}',
    ],
)
def test_anything_else_is_refused_in_words(text):
    with pytest.raises(RequestError, match=r"\w"):
        read_request(text)
