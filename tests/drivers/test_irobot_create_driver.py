import itertools

import numpy as np
import pytest

from drivers.errors import TransportError
from drivers.irobot_create.driver import STREAM_IDS, IrobotCreateSession, session_maker
from drivers.irobot_create.port import wake_line_low
from drivers.irobot_create.protocol import CommandDecoder, Mode, Opcode, PacketId, encode_frame
from simulators.irobot_create import BANNER, FakeCreate
from tests.drivers.irobot_bench import (
    CONFIG,
    CREATE1,
    MS,
    STANDING,
    Bench,
    Curve,
    S,
    bench,
    errors_m_rad,
    largest_step_m,
)

HARMLESS = {Opcode.START, Opcode.STREAM, Opcode.PAUSE_RESUME_STREAM, Opcode.QUERY_LIST, Opcode.STOP}


def test_robot_is_started_and_streams_within_a_fifth_of_a_second():
    table = bench()
    table.run(0.2)
    assert table.samples
    assert table.sent == bytes([128, 148, len(STREAM_IDS), *STREAM_IDS])
    first = table.samples[0]
    assert (first.x_m, first.y_m, first.theta_rad) == (0.0, 0.0, 0.0)
    assert set(first.covariance) == {0.0}
    assert table.session.status == "streaming; battery 84 % (13.9 V, not charging), mode passive"


def test_pose_follows_the_truth_at_66_samples_a_second():
    wheels = Curve()
    table = bench(wheels, start_counts=(65_500, 40))
    samples = table.run(15.0)
    assert 15 * 66.6 - 15 < len(samples) <= 15 * 66.7
    position_m, heading_rad = errors_m_rad(wheels, samples)
    assert position_m < 0.01  # one count is 0.44 mm, of which one wheel may be ahead of the other
    assert heading_rad < 0.004
    assert table.session.counters["encoder_faults"] == 0
    traces = [sum(s.covariance[::4]) for s in samples[::66]]
    assert all(np.diff(traces) > 0.0)


def test_twist_is_smooth_though_reads_are_bunched():
    wheels = Curve(0.3, 0.0)
    table = Bench(FakeCreate(wheels), IrobotCreateSession(CONFIG), read_every_ms=80)
    samples = table.run(10.0)[100:]
    assert len({s.arrived_ns for s in samples}) < len(samples) / 5
    speeds = [s.twist_mps_radps[0] for s in samples]
    assert max(abs(speed - 0.3) for speed in speeds) < 0.01
    assert max(abs(s.twist_mps_radps[2]) for s in samples) < 0.04
    steps_ns = np.diff([s.stamp_ns for s in samples])
    assert np.abs(steps_ns - 15 * MS).max() < 0.3 * MS


def test_bytes_behind_a_frame_in_its_read_do_not_make_it_late():
    session = IrobotCreateSession(CONFIG)
    for now_ns in (0, 100 * MS):
        session.tick(now_ns)
    frame, byte_ns = encode_frame(STREAM_IDS, {}), 10e9 / 115_200
    cut = 0
    for i in range(10, 100):
        last_cut, cut = cut, 10 + i % 20
        ended_ns = i * 15 * MS + round((37 + cut) * byte_ns)  # this frame and the beginning of the next
        (sample,) = session.receive_data(frame[last_cut:] + frame[:cut], ended_ns)
        assert abs(sample.stamp_ns - i * 15 * MS) < 1000


def test_text_of_the_robot_costs_one_frame_and_no_distance():
    wheels = Curve()
    table = bench(wheels, text_every_ns=2 * S)
    samples = table.run(20.0)
    counters = table.session.counters
    assert counters["text_lines"] >= 8
    assert counters["frames_missed"] >= 3
    assert counters["encoder_faults"] == 0
    assert errors_m_rad(wheels, samples)[0] < 0.01
    expected = (samples[-1].stamp_ns - samples[0].stamp_ns) / 15e6 + 1 - counters["frames_missed"]
    assert len(samples) == round(expected)


def test_damaged_bytes_cost_frames_and_no_distance():
    rng = np.random.default_rng(1)

    def spoil(data: bytes, now_ns: int) -> bytes:
        damaged = bytearray(data)
        if now_ns > S and rng.random() < 0.1:
            damaged[int(rng.integers(len(damaged)))] ^= int(rng.integers(1, 256))
        if now_ns > S and rng.random() < 0.05:
            del damaged[int(rng.integers(len(damaged)))]
        return bytes(damaged)

    wheels = Curve()
    table = Bench(FakeCreate(wheels), IrobotCreateSession(CONFIG), spoil=spoil)
    samples = table.run(15.0)
    assert table.session.counters["checksum_failures"] > 25
    assert errors_m_rad(wheels, samples)[0] < 0.01
    assert largest_step_m(samples) < 0.05


def test_impossible_step_of_the_encoders_is_counted_and_not_driven():
    table = bench(STANDING)
    table.run(1.0)
    before = table.samples[-1]
    counts = {43: 5000, 44: 5000, 22: 14_000}
    frames = [encode_frame(STREAM_IDS, counts), encode_frame(STREAM_IDS, counts | {43: 5002, 44: 5002})]
    jumped, moved = (
        table.session.receive_data(frame, table.now_ns + 15 * MS * (i + 1))[0]
        for i, frame in enumerate(frames)
    )
    assert (jumped.x_m, jumped.y_m) == (before.x_m, before.y_m)
    assert jumped.covariance[0] > before.covariance[0]
    assert table.session.counters["encoder_faults"] == 1
    assert moved.x_m == pytest.approx(before.x_m + 2 * CONFIG.left_m_per_count)


def test_damaged_reading_adds_nothing_and_the_path_around_it_is_kept():
    table = bench(STANDING)
    table.run(1.0)
    before = table.samples[-1]
    base = {43: 0, 44: 0, 22: 14_000}
    frames = [base | {43: counts, 44: counts} for counts in (10, 20 ^ 1 << 10, 30, 40)]
    poses = [
        table.session.receive_data(encode_frame(STREAM_IDS, values), table.now_ns + 15 * MS * (i + 1))[0]
        for i, values in enumerate(frames)
    ]
    counts = [(pose.x_m - before.x_m) / CONFIG.left_m_per_count for pose in poses]
    assert counts == pytest.approx([10, 10, 30, 40])
    assert table.session.counters["encoder_faults"] == 1


@pytest.mark.parametrize(("lost", "speed_mps"), [(1, 0.5), (10, 0.5), (200, 0.5), (35, 1.0)])
def test_path_through_lost_frames_is_kept_even_of_a_vehicle_that_rolls_faster(lost, speed_mps):
    wheels = Curve(speed_mps, 0.0)
    gone = []

    def spoil(data: bytes, now_ns: int) -> bytes:
        if data and now_ns > 2 * S and len(gone) < lost:
            gone.append(now_ns)
            return b""
        return data

    table = bench(wheels)
    table.spoil = spoil
    samples = table.run(2.0 + lost * 0.015 + 3.0)
    assert len(gone) == lost
    assert table.session.counters["encoder_faults"] == 0
    seconds = (samples[-1].stamp_ns - samples[0].stamp_ns) / S
    assert samples[-1].x_m == pytest.approx(speed_mps * seconds, abs=0.01 + 0.01 * speed_mps)


def test_what_a_burst_of_noise_holds_does_not_make_frames_old():
    table = bench(STANDING)
    table.run(1.0)
    frame = encode_frame(STREAM_IDS, {43: 0, 44: 0, 22: 14_000})
    before_ns, came_ns = table.samples[-1].stamp_ns, table.samples[-1].arrived_ns
    table.session.receive_data(frame, came_ns + 15 * MS)
    samples = table.session.receive_data(frame + bytes(9_000), came_ns + 30 * MS)  # 0.8 s of the line
    samples += table.session.receive_data(frame, came_ns + 45 * MS)
    assert len(samples) == 2
    for number, sample in enumerate(samples, start=2):
        assert sample.stamp_ns == pytest.approx(before_ns + number * 15 * MS, abs=5 * MS)


def test_reset_robot_is_started_again_without_a_jump():
    wheels = Curve(0.3, 0.0)
    table = bench(wheels, start_counts=(30_000, 31_000))
    table.run(3.0)
    before = table.samples[-1]
    table.robot.reset(table.now_ns)
    samples = table.run(4.0)
    counters = table.session.counters
    assert counters["robot_resets"] == 1
    assert counters["encoder_faults"] == 0
    assert table.session.identity["firmware"].startswith("3.3.0")
    assert len(samples) > 100
    assert largest_step_m([before, *samples]) < 0.006
    gap_s = (samples[0].stamp_ns - before.stamp_ns) / S
    assert samples[0].covariance[0] - before.covariance[0] == pytest.approx((0.5 * gap_s) ** 2 / 3, rel=0.01)


@pytest.mark.parametrize("counts", [(3_000, 2_800), (-200, -1_500), (30_000, 31_000)])
def test_a_reset_without_a_banner_is_not_taken_for_motion(counts: tuple[int, int]):
    def spoil(data: bytes, now_ns: int) -> bytes:
        return b"\xb1\xff\xb1\xff\xff\xff" if BANNER in data else data  # as a Roomba 690 says it

    table = Bench(FakeCreate(STANDING, start_counts=counts), IrobotCreateSession(CONFIG), spoil=spoil)
    table.run(3.0)
    before = table.samples[-1]
    table.robot.reset(table.now_ns)
    samples = table.run(4.0)
    counters = table.session.counters
    assert (counters["silences"], counters["robot_resets"], counters["encoder_faults"]) == (1, 1, 0)
    assert largest_step_m([before, *samples]) == 0.0
    gap_s = (samples[0].stamp_ns - before.stamp_ns) / S
    assert samples[0].covariance[0] - before.covariance[0] == pytest.approx((0.5 * gap_s) ** 2 / 3, rel=0.01)


def test_robot_that_was_stopped_by_someone_else_is_started_again():
    table = bench()
    table.run(1.0)
    table.robot.receive_data(bytes([173]), table.now_ns)
    samples = table.run(2.0)
    assert samples
    assert table.session.counters["silences"] == 1
    assert table.robot.mode is Mode.PASSIVE


def test_robot_that_falls_asleep_is_reported_in_plain_words():
    table = bench(sleep_after_ns=2 * S)
    with pytest.raises(TransportError, match=r"silent for 8 s after \d+ frames; fell asleep"):
        table.run(12.0)


def test_wrong_baud_is_suspected_when_bytes_make_no_frames():
    table = Bench(FakeCreate(STANDING), IrobotCreateSession(CONFIG), spoil=lambda data, _: b"\xe6\x00\x98")
    with pytest.raises(TransportError, match="bytes but no stream frame in 8 s; is 115200"):
        table.run(9.0)
    assert table.samples == []


def test_robot_is_kept_awake_for_hours():
    session = IrobotCreateSession(CONFIG)
    sent = bytearray()
    frame = encode_frame(STREAM_IDS, {})
    for now_ns in range(0, 310 * S, S // 10):
        session.tick(now_ns)
        sent += session.outbox
        session.outbox.clear()
        session.receive_data(frame, now_ns + S // 20)
    assert sent.count(bytes([150, 1])) == 5
    assert sent.count(bytes([128])) == 1
    assert {command.opcode for command in CommandDecoder().receive_data(bytes(sent))} <= HARMLESS


def test_nothing_that_moves_is_ever_sent():
    for config in (CONFIG, CREATE1):
        table = bench(Curve(), config)
        table.run(3.0)
        table.robot.reset(table.now_ns)
        table.run(5.0)
        heard = CommandDecoder().receive_data(bytes(table.sent) + table.session.shutdown_request())
        assert {command.opcode for command in heard} <= HARMLESS
        assert heard[-1].opcode in (Opcode.STOP, Opcode.START)


def test_mode_counted_from_one_is_found_out():
    table = bench(mode_one_too_high=True)
    table.run(1.0)
    assert table.session.identity["oi_mode"] == "reported one too high"
    assert "mode passive" in table.session.status
    table.robot.mode = Mode.SAFE
    table.run(0.1)
    assert "mode safe" in table.session.status


def test_wheel_drop_and_fallback_are_reported():
    table = bench()
    table.run(1.0)
    table.robot.receive_data(bytes([131]), table.now_ns)
    table.run(0.1)
    table.robot.drop_wheel()
    table.run(0.1)
    counters = table.session.counters
    assert (counters["wheel_drops"], counters["fallbacks_to_passive"], counters["mode_changes"]) == (1, 1, 2)
    assert table.session.status.startswith("streaming; wheel dropped: is the robot lifted?, battery")
    table.robot.drop_wheel(False)
    table.run(0.1)
    assert "wheel" not in table.session.status


def test_bumps_cliffs_and_battery_are_reported():
    table = bench()
    table.run(1.0)
    values = table.robot.values
    values |= {PacketId.BUMPS_WHEEL_DROPS: 1, PacketId.CLIFF_RIGHT: 1, PacketId.BATTERY_CHARGE: 206}
    table.run(0.1)
    assert table.session.status == (
        "streaming; cliff ahead, bumper pressed, low battery 10 % (13.9 V, not charging), mode passive"
    )
    assert (table.session.counters["bumps"], table.session.counters["cliffs"]) == (1, 1)
    values |= {PacketId.CHARGING_STATE: 2, PacketId.OI_MODE: 1}
    table.run(0.1)
    assert "cliff" not in table.session.status  # every sensor sees one on the dock
    assert "battery 10 % (13.9 V, charging)" in table.session.status


def test_older_stream_of_the_same_packets_is_not_counted():
    table = bench()
    table.robot.receive_data(bytes([128, 148, len(STREAM_IDS), *STREAM_IDS]), 0)
    table.run(1.0)
    assert table.session.counters["frames_of_old_stream"] >= 5
    steps_ns = np.diff([s.stamp_ns for s in table.samples])
    assert np.abs(steps_ns - 15 * MS).max() < 1.1 * MS


def test_pose_survives_a_reconnect():
    for config in (CONFIG, CREATE1):
        new_session = session_maker(config)
        robot = FakeCreate(Curve(0.3, 0.0, config.wheel_base_m), config.model)
        table = Bench(robot, new_session())
        before = table.run(3.0)[-1]
        table.session = new_session()
        samples = table.run(3.0)
        assert largest_step_m([before, *samples]) < 0.04
        assert samples[0].x_m == pytest.approx(before.x_m)
        assert samples[0].covariance[0] > before.covariance[0]
        assert all(b.stamp_ns > a.stamp_ns for a, b in itertools.pairwise([before, *samples]))


@pytest.mark.parametrize(
    ("second", "low"),
    [(0.0, False), (0.3, True), (0.9, False), (30.0, False), (60.5, True), (61.5, False), (120.1, True)],
)
def test_wake_line_is_pulsed_once_and_then_every_minute(second: float, low: bool):
    assert wake_line_low(second) is low
