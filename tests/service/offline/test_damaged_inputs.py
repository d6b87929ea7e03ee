"""Files that something has changed: each is read or refused in words, with exit code 65 and no traceback."""

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.frames import ImuSample
from service.cli import main
from service.encoding import Message, encode_frame
from service.errors import InputError
from service.recording.mcap_source import open_session
from tests.service.offline.test_carmen import HEAD, corrected_log, flaser, odom, robotlaser
from tests.service.recording.sessions import T0_NS, drive, write_file

SEEDS = [
    pytest.param(range(100), id="100 seeds"),
    pytest.param(range(100, 1000), id="900 seeds", marks=pytest.mark.soak),
]
LEAST_LEFT = 0.06  # such a share has to be read all the same, and such a share to be refused


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
    assert codes[0] > LEAST_LEFT * len(seeds)  # else it is the first line of every log that breaks
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
    """Half are changed in the file, where checksums see most of it, half in messages, where nobody does."""
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
    assert codes[0] > LEAST_LEFT * len(seeds)
    assert codes[InputError.exit_code] > LEAST_LEFT * len(seeds)


def test_frames_of_changed_messages_are_finite(tmp_path):
    """What a mapper gets: ranges that are NaN or lie within the laser's own, angles and stamps it can use."""
    scans = 0
    for seed in range(0, 300, 6):
        dice, path = random.Random(seed), Path(tmp_path / "run.mcap")
        messages = [replace(m, payload=mutated(m.payload, dice)) for m in small_drive()]
        write_file(path, messages)
        try:
            frames = list(open_session([path]).frames())
        except InputError:
            continue
        scans += sum(hasattr(frame, "range_m") for frame in frames)
        for frame in frames:
            if (range_m := getattr(frame, "range_m", None)) is not None:
                seen = range_m[~np.isnan(range_m)]
                assert ((seen > 0.0) & (seen < frame.range_max_m)).all()
                assert abs(frame.angle_step_rad) > 0.0
            assert abs(frame.arrived_ns - T0_NS) < 10**12
    assert scans > 10
