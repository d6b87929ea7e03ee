"""Messages with numbers that no sensor measures; files with damaged bytes are in tests/fuzz."""

import math
import random
import struct
from collections import Counter
from dataclasses import replace

import numpy as np

from drivers.frames import Frame, ImuSample, LaserScan, OdometrySample
from service.encoding import Message, encode_frame
from service.recording.mcap_source import open_session
from tests.service.recording.sessions import drive, write_file


def small_drive() -> list[Message]:
    messages: list[Message] = []
    for message in drive(4):
        messages.append(message)
        stamp_ns = message.stamp_ns + 3
        sample = ImuSample("imu", stamp_ns, stamp_ns, (0.0, 0.0, 0.1), (0.0, 0.0, 9.8))
        messages.append(encode_frame(sample))
    return messages


NO_MEASUREMENTS = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1e30, -1.0, 0.0, 5e-324)
# Bytes of CDR's mark, stamp and names of frames, which say whose message it is.
NAMED_WITHIN = {"front/scan": 24, "imu/imu": 24, "base/odom": 44}


def with_other_numbers(message: Message, dice: random.Random) -> Message:
    """One or two numbers of a message are such as no sensor measures; its length and whose it is stay."""
    if message.channel not in NAMED_WITHIN:  # a mounting
        return message
    content, first = bytearray(message.payload), NAMED_WITHIN[message.channel]
    for _ in range(dice.randint(1, 2)):
        form = dice.choice("fd")  # as a LaserScan has them, as others have
        number = struct.pack(f"<{form}", dice.choice(NO_MEASUREMENTS[:3] if form == "f" else NO_MEASUREMENTS))
        last = dice.choice((first + 28, len(content) - 8))  # seven numbers of a scan stand before its ranges
        at = dice.randrange(first, last) // 4 * 4
        content[at : at + len(number)] = number
    return replace(message, payload=bytes(content))


def usable_numbers(frame: Frame) -> bool:
    """What a mapper may count on. NaN in a scan is no return."""
    match frame:
        case LaserScan():
            seen = frame.range_m[~np.isnan(frame.range_m)]
            return bool(
                ((seen > 0.0) & (seen < frame.range_max_m)).all()
                and 0.0 <= frame.range_min_m < frame.range_max_m < math.inf
                and math.isfinite(frame.first_angle_rad)
                and 0.0 < abs(frame.angle_step_rad) * (frame.range_m.size - 1) < 7.0
                and 0 <= frame.beam_interval_ns < 1e15
                and 0 <= frame.scan_period_ns < 1e15
            )
        case ImuSample():
            if not all(map(math.isfinite, frame.orientation_wxyz or ())):  # by no mapper used as it is
                return False
            values = (*frame.rate_radps, *frame.force_mps2)
        case OdometrySample():
            values = (frame.x_m, frame.y_m, frame.theta_rad, *frame.twist_mps_radps, *frame.covariance)
        case _:
            raise AssertionError(f"none of the drive's: {frame}")
    return max(map(abs, values)) < 1e12  # also false where the first is NaN


def test_numbers_that_no_one_measures_reach_no_mapper(tmp_path):
    """Every message has some: each kind of them is handed on without, or left out and counted."""
    path, handed_on, left_out, kept = tmp_path / "run.mcap", Counter(), Counter(), Counter()
    for seed in range(100):
        dice = random.Random(seed)
        written = [with_other_numbers(message, dice) for message in small_drive()]
        write_file(path, written)
        session = open_session([path])
        for frame in session.frames():
            assert usable_numbers(frame), f"seed {seed}: {type(frame).__name__} of {frame.sensor}"
            handed_on[type(frame)] += 1
        left_out.update({topic: n for topic, n in session.counters.items() if topic.endswith(" unusable")})
        kept.update(m.channel for m in written if m.channel in NAMED_WITHIN)
    for kind in (LaserScan, ImuSample, OdometrySample):
        assert handed_on[kind] > 50, handed_on
    for channel in ("front/scan", "imu/imu", "base/odom"):
        assert left_out[f"/{channel} unusable"] > 10, left_out
    assert handed_on.total() + left_out.total() == kept.total()
