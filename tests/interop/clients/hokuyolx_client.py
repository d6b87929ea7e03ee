"""hokuyolx (PyPI) on a UTM-30LX-EW: dialogue, single and streamed scans, time, sleep, resets."""

import time

import numpy as np
from hokuyolx import HokuyoLX
from reporting import expect, facts, report

SINGLE, STANDBY, ASLEEP = 3, 0, 5
SWEEP_MS = 18.75  # step 0 to 1080
PERIOD_MS = 25.0
SLACK_MS = 3.0  # its clock has whole milliseconds, and so have the client's figures

truth = facts()
walls = truth["walls_mm"]
errors = []
stamps_before_arrival_ms = []


def true_mm(angle_rad):
    """(N,) the walls at these angles, 0 ahead, counter-clockwise; NaN through the window."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    along = np.where(cosine >= 0.0, walls["ahead"], walls["behind"]) / np.abs(cosine)
    across = np.where(sine >= 0.0, walls["left"], walls["right"]) / np.abs(sine).clip(1e-12)
    silent = (angle_rad > truth["silent_rad"][0]) & (angle_rad < truth["silent_rad"][1])
    return np.where(silent, np.nan, np.minimum(along, across))


def compare(scan_mm, angle_rad, what):
    expect(len(scan_mm) == len(angle_rad), f"{what}: {len(scan_mm)} beams for {len(angle_rad)} angles")
    expected = true_mm(angle_rad)
    silent = np.isnan(expected)
    expect(np.all(scan_mm[silent] == truth["no_echo_mm"]), f"{what}: an echo through the window")
    error = scan_mm[~silent].astype(float) - expected[~silent]
    worst = np.abs(error).max()
    expect(worst <= 4 * truth["sigma_mm"] + 1.0, f"{what}: a beam is {worst:.1f} mm off the walls")
    errors.append(error)


def compare_bright(intensity, angle_rad, what):
    seen = ~np.isnan(true_mm(angle_rad))
    expected = truth["white"] * (0.5 + 0.4 * np.cos(angle_rad[seen]))
    worst = np.abs(intensity[seen] - expected).max()
    expect(worst <= 1.0, f"{what}: an intensity is {worst} off")
    expect(not intensity[~seen].any(), f"{what}: light through the window")


def arrived(stamp_ms, no_earlier_ms, what):
    now_ms = time.time() * 1000.0
    expect(
        no_earlier_ms - SLACK_MS <= stamp_ms <= now_ms - SWEEP_MS + SLACK_MS,
        f"{what}: stamped {now_ms - stamp_ms:.1f} ms ago, asked for {now_ms - no_earlier_ms:.1f} ms ago",
    )
    stamps_before_arrival_ms.append(now_ms - stamp_ms)


def state_is(code, when):
    state, words = laser.laser_state()
    expect(state == code, f"{when}: state {state} ({words}), expected {code}")


laser = HokuyoLX(addr=(truth["host"], truth["port"]), time_tolerance=3000)
state_is(SINGLE, "after activate")
version = laser.version()
expect(version["SERI"] in (truth["serial"], int(truth["serial"])), f"serial number {version['SERI']}")
expect((laser.amin, laser.amax, laser.aforw, laser.ares) == (0, 1080, 540, 1440), "geometry of PP")
expect(laser.scan_freq == 40, f"{laser.scan_freq} Hz")
expect(laser.sensor_state()["LASR"] == "ON", "II: the laser is off after BM")

angles = laser.get_angles()
for number in range(3):
    asked_ms = time.time() * 1000.0
    stamp_ms, scan = laser.get_dist()
    arrived(stamp_ms, asked_ms, f"GD {number}")
    compare(scan, angles, f"GD {number}")
_, scan = laser.get_dist(start=200, end=800)
compare(scan, laser.get_angles(200, 800), "GD of a sector")
_, grouped = laser.get_dist(start=300, end=599, grouping=3)
threes = true_mm(laser.get_angles(300, 599)).reshape(-1, 3)
expect(len(grouped) == 100, f"{len(grouped)} groups of 3 in 300 steps")
expect(
    np.abs(grouped - threes.min(axis=1)).max() <= 4 * truth["sigma_mm"] + 1.0, "a group is not its least beam"
)
_, both = laser.get_intens()
compare(both[:, 0], angles, "GE")
compare_bright(both[:, 1], angles, "GE")
_, kept = laser.get_filtered_dist()
expect(len(kept) == np.count_nonzero(~np.isnan(true_mm(angles))), f"{len(kept)} beams pass the filter")


def stream(scans, skips, what):
    """Distances one by one; checks countdown and period."""
    stamps_ms = []
    for scan, stamp_ms, pending in scans:
        stamps_ms.append(stamp_ms)
        expect(pending == COUNT - len(stamps_ms), f"{what}: {pending} pending after {len(stamps_ms)}")
        yield scan, stamp_ms
    steps_ms = np.diff(stamps_ms)
    expected_ms = PERIOD_MS * (1 + skips)
    expect(len(stamps_ms) == COUNT, f"{what}: {len(stamps_ms)} scans of {COUNT}")
    expect(
        np.abs(steps_ms - expected_ms).max() <= 1.0, f"{what}: {steps_ms.tolist()} ms, expected {expected_ms}"
    )


# It reads until a chunk ends in LF LF: once behind, it glues two scans together. Hence full scans at 10 Hz.
COUNT = 10
for skips, first, last in ((3, 0, 1080), (0, 500, 579)):
    laser.activate()
    asked_ms = time.time() * 1000.0
    scans = laser.iter_dist(COUNT, start=first, end=last, skips=skips)
    for scan, stamp_ms in stream(scans, skips, f"MD {first} to {last}"):
        compare(scan, laser.get_angles(first, last), f"MD {first} to {last}")
        if last == 1080:
            arrived(stamp_ms, asked_ms, "MD")
laser.activate()
for both, _ in stream(laser.iter_intens(COUNT, skips=3), 3, "ME"):
    compare(both[:, 0], angles, "ME")
    compare_bright(both[:, 1], angles, "ME")

laser.activate()
endless = laser.iter_dist(start=500, end=579, skips=9)
for _ in range(3):
    scan, _, pending = next(endless)
    expect(pending == 0, f"{pending} pending of an endless stream")
laser.standby()
state_is(STANDBY, "after QT")
laser.sleep()
state_is(ASLEEP, "after %SL")
laser.standby()
laser.reset()
laser.partial_reset()
laser.reboot()
laser.close()

error = np.concatenate(errors)
expect(abs(error.mean()) < 0.5, f"{error.mean():.2f} mm off the walls on average")
expect(
    0.9 < error.std() / truth["sigma_mm"] < 1.1, f"sigma {error.std():.1f} mm, expected {truth['sigma_mm']}"
)
report(
    scans=len(errors),
    beams=len(error),
    error_mm=error.mean(),
    sigma_mm=error.std(),
    stamp_ms=max(stamps_before_arrival_ms),
)
