"""Files that something has changed: each is read or refused in words, with exit code 65 and no traceback."""

import math
import random
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import Frame, ImuSample, LaserScan, OdometrySample
from service.cli import main
from service.encoding import Message, encode_frame
from service.errors import InputError
from service.recording.mcap_source import open_session
from tests.service.offline.importing.test_carmen import HEAD, corrected_log, flaser, odom, robotlaser
from tests.service.recording.sessions import drive, write_file

SEEDS = [
    pytest.param(range(50), id="50 seeds"),
    pytest.param(range(50, 1000), id="950 seeds", marks=pytest.mark.soak),
]
MIN_LEFT = 0.06  # such a share has to be read all the same, and such a share to be refused


def mutated(data: bytes, dice: random.Random) -> bytes:
    """The same with some bytes changed, or a piece cut out, doubled, swapped or put in."""
    content = bytearray(data)
    for _ in range(dice.randint(1, 4)):
        if not content:
            break
        at, size = dice.randrange(len(content)), dice.randint(1, 64)
        match dice.randrange(6):
            case 0:
                content[at] ^= 1 << dice.randrange(8)
            case 1:
                content[at] = dice.choice((0, 0x7F, 0x80, 0xFF))
            case 2:
                del content[at : at + size]
            case 3:
                content[at:at] = content[at : at + size]
            case 4:
                content[at : at + 8] = dice.choice((b"\xff" * 8, b"\0" * 8, b"\0\0\0\0\0\0\xf0\x7f"))
            case 5:
                del content[max(at, 1) :]
    return bytes(content)


def exit_codes(
    of_seed: Callable[[int], list[str]], seeds: range, capsys: pytest.CaptureFixture[str]
) -> Counter[int]:
    """Of the command for each seed; what was said, is said in words."""
    codes: Counter[int] = Counter()
    for seed in seeds:
        command = of_seed(seed)
        code = main(command)
        said = capsys.readouterr().err
        assert "Traceback" not in said, f"seed {seed}: {said}"
        assert code in (0, InputError.exit_code), f"seed {seed}: exit code {code}, {said}"
        assert (code == 0) or said.startswith("corridor: "), f"seed {seed}: {said}"
        codes[code] += 1
    return codes


@pytest.mark.timeout(600)
@pytest.mark.parametrize("seeds", SEEDS)
def test_carmen_logs_with_changed_bytes_are_read_or_refused(seeds, tmp_path, capsys):
    pose = (1.0, 2.0, 0.5)
    log = (
        HEAD
        + "PARAM robot_frontlaser_offset -0.04 1 merlin 1\n"
        + flaser("10.1", pose, ranges=[2.5] * 9)
        + odom("10.2", 0.1, 0.0, 0.0, tv=0.5)
        + robotlaser("10.3", pose, pose, [4.0, 5.0, 81.91, 6.0], remissions=[7, 8])
        + corrected_log().replace(" 2.0" * 180, " 2.0" * 12).replace("FLASER 180", "FLASER 12")
    ).encode()

    def command(seed: int) -> list[str]:
        (tmp_path / "run.log").write_bytes(mutated(log, random.Random(seed)))
        return ["import", "carmen", str(tmp_path / "run.log"), str(tmp_path / "out.mcap")]

    codes = exit_codes(command, seeds, capsys)
    assert codes[0] > MIN_LEFT * len(seeds)  # else it is the first line of every log that breaks
    assert codes[InputError.exit_code] > 0


def small_drive() -> list[Message]:
    messages: list[Message] = []
    for message in drive(4):
        messages.append(message)
        stamp_ns = message.stamp_ns + 3
        sample = ImuSample("imu", stamp_ns, stamp_ns, (0.0, 0.0, 0.1), (0.0, 0.0, 9.8))
        messages.append(encode_frame(sample))
    return messages


@pytest.mark.timeout(600)
@pytest.mark.parametrize("seeds", SEEDS)
def test_recordings_with_changed_bytes_are_read_or_refused(seeds, tmp_path, capsys):
    """Half are changed in the file, where checksums see most of it, half in messages, where no one does."""
    write_file(tmp_path / "whole.mcap", small_drive(), sync_every=5)
    whole = (tmp_path / "whole.mcap").read_bytes()

    def command(seed: int) -> list[str]:
        dice, path = random.Random(seed), tmp_path / "run.mcap"
        if seed % 2:
            path.write_bytes(mutated(whole, dice))
        else:
            messages = small_drive()
            for k in dice.sample(range(len(messages)), 5):
                messages[k] = replace(messages[k], payload=mutated(messages[k].payload, dice))
            write_file(path, messages)
        return ["import", "rosbag", str(path), str(tmp_path / "out.mcap")]

    codes = exit_codes(command, seeds, capsys)
    assert codes[0] > MIN_LEFT * len(seeds)
    assert codes[InputError.exit_code] > MIN_LEFT * len(seeds)


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
