"""pyroombaadapter (PyPI) on a Create 2: single packets, a stream, drive commands, back to Passive."""

import time

from pyroombaadapter import PyRoombaAdapter
from reporting import expect, facts, report

SAFE = 2
COUNTS = 65_536
FRAMES, FRAME_S = 150, 0.015

truth = facts()
robot = PyRoombaAdapter(truth["port"])
expect(robot.request_oi_mode() == SAFE, "not in Safe mode after the start")
answers = [
    (robot.request_charging_state, 0),
    (robot.request_voltage, truth["voltage_mv"]),
    (robot.request_current, truth["current_ma"]),
    (robot.request_temperature, truth["temperature_degc"]),
    (robot.request_charge, truth["charge_mah"]),
    (robot.request_capacity, truth["capacity_mah"]),
]
for ask, expected in answers:
    got = ask()
    expect(got == expected, f"{ask.__name__}: {got}, expected {expected}")

before_ns = time.monotonic_ns()
counts = robot.request_encoder_counts()
after_ns = time.monotonic_ns()
for reading, start, speed_mps in zip(
    counts, truth["start_counts"], (truth["left_mps"], truth["right_mps"]), strict=True
):
    early, late = (
        start + int(speed_mps * (now_ns - truth["start_ns"]) * 1e-9 / truth["m_per_count"])
        for now_ns in (before_ns, after_ns)
    )
    expect((reading - early) % COUNTS <= late - early, f"{reading} counts, expected {early} to {late}")

robot.request_distance()
from_ns = time.monotonic_ns()
time.sleep(1.0)  # the distance of one second is measured
distance_mm = robot.request_distance()
true_mm = 500.0 * (truth["left_mps"] + truth["right_mps"]) * (time.monotonic_ns() - from_ns) * 1e-9
expect(abs(distance_mm - true_mm) <= 15.0, f"{distance_mm} mm of {true_mm:.0f} mm")

robot.move(0.2, 0.0)
robot.data_stream_start(["Left Encoder Counts", "Right Encoder Counts", "Voltage", "Requested Velocity"])
frames = [robot.data_stream_read() for _ in range(FRAMES)]
broken = [number for number, frame in enumerate(frames) if len(frame) != 4]
expect(not broken, f"frames {broken} of {FRAMES} cannot be read")
expect({frame[2] for frame in frames} == {truth["voltage_mv"]}, "voltages in the stream")
expect({frame[3] for frame in frames} == {200}, "velocities in the stream, after move(0.2, 0)")
counted = []
for side, speed_mps in enumerate((truth["left_mps"], truth["right_mps"])):
    counts = (frames[-1][side] - frames[0][side]) % COUNTS
    expected = speed_mps * (FRAMES - 1) * FRAME_S / truth["m_per_count"]
    expect(abs(counts - expected) <= 1.0, f"{counts} counts in {FRAMES} frames, expected {expected:.1f}")
    counted.append((counts, expected))

robot.data_stream_stop()
while robot.serial_con.read(256):  # data in transit; a second without data ends it
    pass
expect(robot.request_voltage() == truth["voltage_mv"], "no clean answer after the stream")
del robot  # sends start (128) and closes
report(requests=len(answers) + 4, frames=FRAMES, left_counts=counted[0][0], true_left_counts=counted[0][1])
