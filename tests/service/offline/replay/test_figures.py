from dataclasses import replace

import numpy as np

from service.geometry.se2 import SE2
from service.offline.replay.figures import SensorRates, StateReasons, doubts
from service.outputs import MapperOutput, Reason, State
from tests.service.offline.recorded_drives import T0_NS, odometry_at, room_scan

PERIOD_NS = 20_000_000
STEP_NS = 100_000_000


def rates_of(*scans: int) -> dict:
    """Of a laser that scanned at these multiples of 20 ms."""
    rates = SensorRates()
    for k in scans:
        rates.add(room_scan(T0_NS + k * PERIOD_NS, 0.0))
    return rates.as_dict(T0_NS)["front/scan"]


def test_an_interval_of_more_than_three_periods_is_a_gap():
    assert rates_of(*range(10), *range(12, 20), *range(60, 70)) == {
        "frames": 28,
        "rate_hz": 50.0,
        "gaps": 1,
        "longest_gaps": [[0.38, 0.82]],
    }


def test_kinds_of_one_sensor_are_distinguished_and_a_single_frame_has_no_rate():
    rates = SensorRates()
    rates.add(replace(odometry_at(0, 0.0), sensor="front"))
    rates.add(room_scan(T0_NS, 0.0))
    assert list(rates.as_dict(T0_NS)) == ["front/odom", "front/scan"]
    assert rates.as_dict(T0_NS)["front/odom"]["rate_hz"] is None


def reasons_of(facts: list[tuple[State, str]]) -> StateReasons:
    """Of outputs a tenth of a second apart."""
    reasons = StateReasons()
    for k, (state, words) in enumerate(facts):
        pose, reason = SE2(), Reason("off_map" if words else "", words)
        reasons.add(
            MapperOutput(T0_NS + k * STEP_NS, pose, pose, (0.0, 0.0, 0.0), np.eye(3), state, reason, 1.0)
        )
    return reasons


def test_reasons_that_differ_in_numbers_alone_are_one_kind():
    reasons = reasons_of(
        [
            ("ok", ""),
            ("lost", "12% of 180 returns lie on the map"),
            ("lost", "front_1: 0 of 180 beams returned"),
            ("lost", "9% of 181 returns lie on the map"),
            ("degraded", "12% of 180 returns lie on the map"),
            ("lost", "+0.50 m ahead, -1 m left"),
            ("lost", "-3 m ahead, +1.25 m left"),
            ("lost", "10% of 180 returns lie on the map"),
            ("lost", "front_2: 3 of 180 beams returned"),
        ]
    ).as_dict()
    short = {
        state: [(kind["reason"], kind["scans"], kind["first_s"]) for kind in kinds]
        for state, kinds in reasons.items()
    }
    assert short == {
        "degraded": [("12% of 180 returns lie on the map", 1, 0.4)],
        "lost": [
            ("12% of 180 returns lie on the map", 3, 0.1),
            ("+0.50 m ahead, -1 m left", 2, 0.5),
            ("front_1: 0 of 180 beams returned", 1, 0.2),
            ("front_2: 3 of 180 beams returned", 1, 0.8),
        ],
    }
    assert {kind["id"] for kinds in reasons.values() for kind in kinds} == {"off_map"}


def test_of_each_state_but_ok_the_main_reason_is_reported():
    facts = reasons_of([("ok", ""), *[("lost", "no returns")] * 2, ("lost", "elsewhere")]).as_dict()
    summary = {"scans": 4, "state": {"ok": 1, "degraded": 0, "lost": 3}, "state_reasons": facts}
    assert list(doubts(summary)) == ["3 of 4 scans were lost; 2 of them, from 0.1 s on: no returns"]
