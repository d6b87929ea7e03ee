"""pycreate2 (PyPI) on a Create 2: modes, all sensors in 80 bytes, drive commands, stop."""

import math
import time

from pycreate2 import Create2
from reporting import expect, facts, report

SAFE, FULL = 2, 3
COUNTS = 65_536
SECONDS = 2.0

truth = facts()


def counts_at(now_ns, side):
    """Counts of an encoder at host time now_ns, not wrapped."""
    start = truth["start_counts"][side]
    speed_mps = truth["left_mps"] if side == 0 else truth["right_mps"]
    return start + math.floor(speed_mps * (now_ns - truth["start_ns"]) * 1e-9 / truth["m_per_count"])


def read(robot):
    """(before ns, sensors, after ns), the encoders compared with the truth between both moments."""
    before_ns = time.monotonic_ns()
    sensors = robot.get_sensors()
    after_ns = time.monotonic_ns()
    for side, reading in enumerate((sensors.encoder_counts_left, sensors.encoder_counts_right)):
        early, late = counts_at(before_ns, side), counts_at(after_ns, side)
        expect((reading - early) % COUNTS <= late - early, f"{reading} counts, expected {early} to {late}")
        slack.append(late - early)
    return before_ns, sensors, after_ns


slack = []
robot = Create2(truth["port"])
robot.start()
robot.safe()
_, sensors, _ = read(robot)
expect(sensors.open_interface_mode == SAFE, f"mode {sensors.open_interface_mode} after safe")
expect(sensors.voltage == truth["voltage_mv"], f"{sensors.voltage} mV")
expect(sensors.current == truth["current_ma"], f"{sensors.current} mA")
expect(sensors.temperature == truth["temperature_degc"], f"{sensors.temperature} degrees")
expect(sensors.battery_charge == truth["charge_mah"], f"{sensors.battery_charge} mAh")
expect(sensors.battery_capacity == truth["capacity_mah"], f"{sensors.battery_capacity} mAh")
cliffs = [
    sensors.cliff_left_signal,
    sensors.cliff_front_left_signal,
    sensors.cliff_front_right_signal,
    sensors.cliff_right_signal,
]
expect(cliffs == truth["cliff_signals"], f"cliff signals {cliffs}")
bumps = [
    sensors.light_bumper_left,
    sensors.light_bumper_front_left,
    sensors.light_bumper_center_left,
    sensors.light_bumper_center_right,
    sensors.light_bumper_front_right,
    sensors.light_bumper_right,
]
expect(bumps == truth["bump_signals"], f"bumper signals {bumps}")
expect(not any(sensors.bumps_wheeldrops), f"{sensors.bumps_wheeldrops}")

first_ns, _, _ = read(robot)
readings, distance_mm, angle_deg = 0, 0, 0
while True:
    last_ns, sensors, _ = read(robot)
    readings += 1
    distance_mm += sensors.distance
    angle_deg += sensors.angle
    if last_ns - first_ns > SECONDS * 1e9:
        break
    time.sleep(0.1)  # the program has no event: it requests the distance since the last answer
seconds = (last_ns - first_ns) * 1e-9
true_distance_mm = 500.0 * (truth["left_mps"] + truth["right_mps"]) * seconds
lost_mm = readings + 30.0  # each reading cuts off less than a millimetre; the first may be late by some ms
expect(abs(distance_mm - true_distance_mm) <= lost_mm, f"{distance_mm} mm of {true_distance_mm:.0f} mm")
expect(angle_deg >= 0, f"{angle_deg} degrees in a left turn")

robot.full()
robot.drive_direct(100, -50)
_, sensors, _ = read(robot)
expect(sensors.open_interface_mode == FULL, f"mode {sensors.open_interface_mode} after full")
expect((sensors.velocity_right, sensors.velocity_left) == (100, -50), "velocities of drive_direct")
robot.drive_stop()
_, sensors, _ = read(robot)
expect((sensors.velocity_right, sensors.velocity_left) == (0, 0), "velocities after drive_stop")
del robot  # sends stop (173) and closes
report(
    readings=readings,
    slack_counts=max(slack),
    seconds=seconds,
    distance_mm=distance_mm,
    true_distance_mm=true_distance_mm,
)
