"""Four layers into one: labels, layers, echoes, ground and grid, by hand-made scans and by plain loops."""

import math
from collections import Counter

import numpy as np
import pytest

from drivers.frames import CAUSES, causes_of
from drivers.ibeo_lux.messages import ScanFlag, read_scan
from drivers.ibeo_lux.reduction import LayerReduction, elevation_rad
from tests.drivers.lux import config, scan

COS_INNER, COS_OUTER = math.cos(math.radians(0.4)), math.cos(math.radians(1.2))
GROUND, DIRT, RAIN, TRANSPARENT = 0x04, 0x08, 0x02, 0x01
ALL_LABELS = (
    ScanFlag.GROUND_LABELLED | ScanFlag.DIRT_LABELLED | ScanFlag.RAIN_LABELLED | ScanFlag.TRANSPARENT_LABELLED
)


def reduce(*rows, flags=0, tilt_rad=0.0, scan_changes=None, **changes):
    """Beams by angle in ticks, NaN left out; and the counters."""
    counters = Counter()
    reduction = LayerReduction(config(**changes), counters)
    reduction.beam_tilt_rad = tilt_rad
    beams = reduction.reduce(scan(*rows, flags=flags, **scan_changes or {}))
    angle = beams.first_ticks - beams.step_ticks * np.arange(len(beams.range_m))
    seen = ~np.isnan(beams.range_m)
    return dict(zip(angle[seen].tolist(), beams.range_m[seen].tolist(), strict=True)), counters


def test_layers_look_1_2_degrees_down_to_1_2_up_and_ranges_are_laid_level():
    assert np.degrees(elevation_rad(np.arange(4), np.zeros(4))) == pytest.approx([-1.2, -0.4, 0.4, 1.2])
    beams, _ = reduce((0, 0, 0, 160, 10_000, 1), (1, 0, 0, 80, 10_000, 1))
    assert beams == pytest.approx({160: 100.0 * COS_OUTER, 80: 100.0 * COS_INNER}, rel=1e-6)


def test_tilted_mirror_bends_front_scans_down_and_rear_scans_up():
    # 8 layers: 4 below and 4 above where the sides meet, straight ahead; no tilt seen 90 deg to the left.
    tilt = math.radians(1.6)
    for rear, sign in ((False, -1.0), (True, 1.0)):
        ahead = np.degrees(elevation_rad(np.arange(4), np.zeros(4), tilt, rear))
        assert ahead == pytest.approx(np.array([-1.2, -0.4, 0.4, 1.2]) + sign * 1.6)
        left = np.degrees(elevation_rad(np.arange(4), np.full(4, math.pi / 2), tilt, rear))
        assert left == pytest.approx([-1.2, -0.4, 0.4, 1.2])
    rear_up, _ = reduce((3, 0, 0, 0, 10_000, 1), tilt_rad=tilt, flags=ScanFlag.REAR_MIRROR_SIDE)
    assert rear_up[0] == pytest.approx(100 * math.cos(math.radians(2.8)), rel=1e-7)
    turned, _ = reduce(
        (3, 0, 0, 0, 10_000, 1),
        tilt_rad=tilt,
        flags=ScanFlag.REAR_MIRROR_SIDE,
        scan_changes={"status": 0x830B},  # upside down
    )
    assert turned[0] == pytest.approx(100 * math.cos(math.radians(0.4)), rel=1e-7)


def test_pitch_changes_which_layer_is_nearest_to_the_horizon():
    rows = [(0, 0, 0, 0, 500, 1), (1, 0, 0, 0, 600, 1), (2, 0, 0, 0, 700, 1), (3, 0, 0, 0, 800, 1)]
    for pitch_deg, metres in ((1.2, 8.0), (-1.2, 5.0), (0.4, 7.0)):
        beams, _ = reduce(*rows, pitch_deg=pitch_deg)
        assert beams[0] == pytest.approx(metres, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "bit", "flag"),
    [
        ("ground", GROUND, ScanFlag.GROUND_LABELLED),
        ("dirt", DIRT, ScanFlag.DIRT_LABELLED),
        ("rain", RAIN, ScanFlag.RAIN_LABELLED),
        ("transparent", TRANSPARENT, ScanFlag.TRANSPARENT_LABELLED),
    ],
)
def test_label_counts_only_where_the_labelling_ran_and_the_config_says_so(name, bit, flag):
    row = (1, 0, bit | 0xF0, 0, 500, 1)
    assert reduce(row, flags=ALL_LABELS ^ flag)[0].keys() == {0}
    beams, counters = reduce(row, flags=flag)
    assert beams == {}
    assert counters == {f"points_{name}": 1}
    beams, counters = reduce(row, flags=flag, discard=())
    assert beams.keys() == {0}
    assert counters == {f"points_{name}": 1}


def test_a_beam_in_which_only_labelled_points_lie_has_the_label_as_its_cause():
    rows = [(1, 0, RAIN, 0, 500, 1), (1, 0, RAIN, 8, 500, 1), (2, 0, 0, 8, 900, 1), (1, 0, DIRT, 16, 500, 1)]
    reduction = LayerReduction(config(discard=("rain",), angle_step_deg=0.25), Counter())
    beams = reduction.reduce(scan(*rows, flags=ScanFlag.RAIN_LABELLED | ScanFlag.DIRT_LABELLED))
    at = {beams.first_ticks - beams.step_ticks * k: k for k in range(len(beams.range_m))}
    causes = causes_of(beams.range_m)
    assert [CAUSES[causes[at[ticks]]] for ticks in (0, 8, 16)] == ["rain", "no_return", "no_return"]
    assert np.isnan(beams.range_m[at[0]])
    assert not np.isnan(beams.range_m[[at[8], at[16]]]).any()


def test_points_out_of_range_layer_echo_or_field_are_left_out_and_counted():
    rows = [
        (1, 0, 0, 0, 29, 1),
        (1, 0, 0, 8, 20_001, 1),
        (4, 0, 0, 16, 500, 1),
        (1, 3, 0, 24, 500, 1),
        (1, 0, 0, 1601, 500, 1),
        (1, 0, 0, -1921, 500, 1),
        (1, 0, 0, 1600, 500, 1),
        (1, 0, 0, -1920, 500, 1),
    ]
    beams, counters = reduce(*rows)
    assert beams.keys() == {1600, -1920}
    assert counters == {"points_out_of_range": 2, "points_malformed": 4}


def test_points_near_the_ground_do_not_count_where_the_height_is_known():
    at_ground_cm = round(50 / math.sin(math.radians(1.2)))  # 23.9 m ahead of a sensor 0.5 m up
    rows = [(0, 0, 0, 0, at_ground_cm, 1), (0, 0, 0, 80, 1500, 1), (3, 0, 0, 0, 4000, 1)]
    beams, counters = reduce(*rows, height_m=0.5)
    assert beams == pytest.approx({0: 40.0 * COS_OUTER, 80: 15.0 * COS_OUTER}, rel=1e-5)
    assert counters == {"points_below_ground_limit": 1}
    pitched, _ = reduce(*rows, height_m=0.5, pitch_deg=0.5)  # 15 m along the low layer is 6 cm up
    assert pitched == pytest.approx({0: 40.0 * math.cos(math.radians(0.7))}, rel=1e-5)


def test_mounting_that_leans_puts_points_where_they_are():
    # A point 10 m to the left of a sensor rolled by 20 deg to the right lies 9.4 m to the left and 3.4 m up.
    row = (1, 0, 0, 1440, 1000, 1)
    beams, _ = reduce(row, roll_deg=20.0, layers=(1,))
    [(angle, range_m)] = beams.items()
    h, v = math.radians(45.0), math.radians(-0.4)
    x, y, z = math.cos(v) * math.cos(h), math.cos(v) * math.sin(h), math.sin(v)
    y, z = y * math.cos(math.radians(20)) - z * math.sin(math.radians(20)), 0.0
    assert range_m == pytest.approx(10 * math.hypot(x, y), rel=1e-6)
    assert angle / 32 == pytest.approx(math.degrees(math.atan2(y, x)), abs=0.07)


@pytest.mark.parametrize("choice", ["horizon", "nearest", "median"])
@pytest.mark.parametrize("echo", ["first", "last", "strongest"])
def test_reduction_agrees_with_plain_loops_on_random_scans(choice, echo):
    rng = np.random.default_rng(11)
    rank = {0: 1, 1: 0, 2: 0, 3: 1}
    for _ in range(8):
        shots = {(int(rng.integers(0, 4)), int(angle)) for angle in rng.integers(-300, 301, 400)}
        rows = [
            (
                layer,
                e,
                int(rng.integers(0, 256)),
                angle,
                int(rng.integers(10, 3000)),
                int(rng.integers(1, 999)),
            )
            for layer, angle in sorted(shots, key=lambda shot: -shot[1])
            for e in range(int(rng.integers(1, 4)))
        ]
        by_beam = {}
        by_shot = {shot: [] for shot in shots}
        for r in rows:
            if r[4] >= 30 and not r[2] & (DIRT | RAIN):
                by_shot[r[0], r[3]].append(r)
        for layer, angle in shots:
            if echoes := by_shot[layer, angle]:
                pick = {"first": echoes[0], "last": echoes[-1], "strongest": max(echoes, key=lambda r: r[5])}
                by_beam.setdefault(math.floor((320 - angle) / 8 + 0.5), []).append(pick[echo])
        expected = np.full(81, np.nan)
        for beam, picks in by_beam.items():
            in_order = sorted(r[4] for r in picks)
            best = {
                "nearest": in_order[0],
                "median": in_order[(len(in_order) - 1) // 2],
                "horizon": min(picks, key=lambda r: (rank[r[0]], r[4]))[4],
            }[choice]
            expected[beam] = best / 100
        flags = ScanFlag.DIRT_LABELLED | ScanFlag.RAIN_LABELLED
        reduction = LayerReduction(
            config(layer_choice=choice, echo=echo, angle_step_deg=0.25, discard=("dirt", "rain")), Counter()
        )
        beams = reduction.reduce(scan(*rows, first=320, last=-320, flags=flags))
        np.testing.assert_allclose(beams.range_m, expected, rtol=3e-4)


def test_real_scan_keeps_its_points_though_120_carry_a_label_that_did_not_run(shared):
    real = read_scan((shared / "captures/ibeo/ldmrs_scan_payload_0x2202.bin").read_bytes())
    counters = Counter()
    beams = LayerReduction(config(), counters).reduce(real)
    directions = set(real.points["angle_ticks"].tolist())
    assert np.count_nonzero(~np.isnan(beams.range_m)) == len(directions) == 70
    assert counters == {}
    assert (beams.first_ticks, beams.step_ticks, len(beams.range_m)) == (1600, 4, 801)
    assert beams.range_m[0] == pytest.approx(1.25 * COS_INNER, rel=1e-6)
