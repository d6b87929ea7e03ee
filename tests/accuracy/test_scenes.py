"""Scenes are what they say: as many returns, at that speed, the same each time."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import LaserScan, OdometrySample
from simulators.trajectory import SPEED, TURN_RATE
from simulators.worlds import WORLDS
from tests.accuracy.scene_drives import LEGS, SCENES, Case, Stage, driven, returns_share, staged
from tests.accuracy.scene_judge import Verdict
from tests.accuracy.scenes import SHARES, SPEEDS_MPS, cases_of, rows, table

VERDICT = Verdict(900, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.1, 0.5, 0.05, 0.4, 0.0, 3)


@pytest.mark.parametrize("moment", [0.0, 0.6])
def test_lap_is_driven_from_any_place_at_any_speed(moment: float) -> None:
    world = driven(WORLDS["office"](), moment, 1.5, 60.0)
    nodes = world.drive.nodes
    assert nodes[:, SPEED].max() == pytest.approx(1.5, rel=0.01)
    assert np.abs(nodes[:, TURN_RATE]).max() < 1.05 * LEGS.turn_rate_radps
    lap_m = WORLDS["office"]().drive.length_m
    here, later = world.drive.poses(np.interp([5.0, 5.0 + lap_m], nodes[:, 0], 0.01 * np.arange(len(nodes))))
    assert np.hypot(*(here - later)[:2]) < 0.02


@pytest.mark.soak  # of the bench's own drives
@pytest.mark.parametrize("scene", ["escort", "ring_of_people", "train_along"])
def test_people_and_trains_have_their_share_of_the_returns(scene: str) -> None:
    world = driven(WORLDS["library"](), 0.1, 1.0, 40.0)
    still = Stage(Case(scene, "library", share=0.33), world, 12.0, 20.0)
    few = returns_share(still, SCENES[scene].change(still))
    more = replace(still, case=replace(still.case, share=0.45))
    many = returns_share(still, SCENES[scene].change(more))
    assert 0.33 <= few < 0.45 <= many < 0.7


@pytest.mark.soak  # of the bench's own drives
def test_same_case_is_the_same_drive() -> None:
    one, again = (staged(Case("ahead", "ring", for_s=1.0)) for _ in range(2))
    scans, others = ([f for f in of.made.frames if isinstance(f, LaserScan)] for of in (one, again))
    assert len(scans) == len(others)
    for scan, other in zip(scans, others, strict=True):
        np.testing.assert_array_equal(scan.range_m, other.range_m)


@pytest.mark.soak  # of the bench's own drives
def test_towed_vehicle_moves_while_its_wheels_stand_and_its_laser_is_silent() -> None:
    of = staged(Case("towed", "ring"))
    during = [f for f in of.made.frames if of.from_ns <= f.stamp_ns and f.arrived_ns < of.to_ns]
    assert not any(isinstance(frame, LaserScan) for frame in during)
    poses = [(f.x_m, f.y_m) for f in during if isinstance(f, OdometrySample)]
    assert np.ptp(poses, axis=0).max() == 0.0
    moved = of.made.at(of.from_ns).inverse() @ of.made.at(of.to_ns)
    assert np.hypot(moved.x_m, moved.y_m) > 2.0


def test_cases_take_every_speed_and_share_together() -> None:
    cases = cases_of("escort", "office", range(11, 16), 6)
    assert len(cases) == 30
    assert len({(case.speed_mps, case.share) for case in cases}) == len(SPEEDS_MPS) * len(SHARES)
    assert len({case.moment for case in cases}) == 30


def test_bounds_are_those_of_the_worst_run() -> None:
    bad = replace(
        VERDICT,
        ok_off=1,
        needless_still_percent=2.0,
        fault_m=1.0,
        fault_percent=10.0,
        right_after_s=3.0,
        ghosts=50,
    )
    met = {row.what: row.met for row in rows("escort", [VERDICT, VERDICT])}
    assert set(met.values()) == {True}
    assert {row.met for row in rows("escort", [VERDICT, bad])} == {False}
    without_witness = rows("towed", [bad])
    assert [row.what for row in without_witness] == [
        "towed: `ok` and 0.3 m off",
        "towed: needless before and after",
    ]
    (*_, end) = rows("escort5_s41_0_16s", [replace(bad, end_m=0.2)])
    assert (end.what, end.met) == ("escort5_s41_0_16s: off at the end", False)


def test_table_sums_counts_and_shows_the_worst() -> None:
    shown = table({("escort", "office"): [VERDICT, replace(VERDICT, ok_off=7, end_m=2.5, ghosts=-4)]})
    cells = [cell.strip() for cell in shown.splitlines()[-1].split("|")]
    assert cells[1:5] == ["escort", "office", "2", "7"]
    assert "2.50 m" in cells
    assert cells[-2] == "3"
