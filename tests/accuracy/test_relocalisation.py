"""The benchmark of relocalisation calls right, wrong and lost what is."""

import math

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.profiles import BeginIn
from tests.accuracy.relocalisation import Known, Look, Looks, is_reported, look
from tests.service.mapper.graph.relocalise.test_known_map import (
    APART_M,
    STOOD,
    append,
    looked_for,
    room,
    rooms,
)
from tests.service.mapper.offices import mapped_office, through
from tests.simulated import FORWARD, Drive


@pytest.fixture(scope="module")
def mapped() -> tuple[Drive, BeginIn]:
    return mapped_office()


@pytest.mark.parametrize(("off_m", "is_right"), [(0.0, True), (0.3, False)])
def test_a_place_is_right_where_the_truth_is_and_wrong_beside_it(mapped, off_m: float, is_right: bool):
    drove, begin = mapped
    later = through("office", 2.0, 4, stand_s=-12.0)
    to_map = SE2(0.0, off_m, 0.0) @ drove.world_first.inverse() @ later.world_first
    truth = {ns: np.array([*_xy(to_map @ pose)]) for ns, pose in later.truth.items()}
    known = Known(begin, {"front": FORWARD}, begin.graph.map)
    found = look(known, later.frames, truth)
    assert (found.is_right, found.is_wrong) == (is_right, not is_right)
    assert found.off_mm == pytest.approx(1e3 * off_m, abs=30.0)
    assert found.found_s < 1.0


def test_of_a_vehicle_that_is_lost_it_is_reported_whether_another_place_is_likelier(mapped):
    """Of one that looks at nothing: no place at all."""
    begin = mapped[1]
    later = through("office", 1.0, 4, stand_s=-12.0)
    blind = [frame for frame in later.frames if not hasattr(frame, "range_m")][:1]
    known = Known(begin, {"front": FORWARD}, begin.graph.map)
    found = look(known, blind, {})
    assert (found.is_right, found.is_wrong, found.is_likelier_elsewhere) == (False, False, False)
    assert math.isnan(found.found_s)


def test_of_two_places_that_are_alike_the_true_one_is_reported():
    keyframes, noise = rooms(pillar_in_first=False, pillar_in_second=False)
    search, _ = looked_for(keyframes, append(keyframes, room(0.0, with_pillar=False), STOOD, 1, noise))
    truth = np.array([STOOD.x_m, STOOD.y_m, STOOD.theta_rad])
    assert is_reported(search, truth)
    assert is_reported(search, truth + np.array([APART_M, 0.0, 0.0]))
    assert not is_reported(search, truth + np.array([0.5 * APART_M, 0.0, 0.0]))


def test_of_two_places_of_which_one_has_a_pillar_none_is_reported():
    keyframes, noise = rooms(pillar_in_first=True, pillar_in_second=False)
    search, _ = looked_for(keyframes, append(keyframes, room(0.0, with_pillar=True), STOOD, 1, noise))
    assert not is_reported(search, np.array([STOOD.x_m, STOOD.y_m, STOOD.theta_rad]))


def test_rows_count_each_start_once():
    right = Look(True, False, False, False, False, 0.1, 0.2, 5.0)
    wrong = Look(False, True, True, False, False, 0.1, 1.2, 500.0)
    alike = Look(False, False, False, True, False, math.nan, 0.3, 900.0)
    elsewhere = Look(False, False, False, False, True, math.nan, 0.3, 900.0)
    looks = [right, right, wrong, alike, elsewhere]
    rows = {row.what: row for row in Looks(looks).rows("office", "standing")}
    assert rows["standing: right, of 5"].values == [40.0]
    assert rows["standing: right, or lost between two that are alike"].values == [60.0]
    assert rows["standing: right, or lost between two that are alike"].met is False
    counts = {
        "lost": 2.0,
        "lost between two that are alike, the true one told": 1.0,
        "lost, and likelier elsewhere": 1.0,
        "wrong": 1.0,
    }
    for what, count in counts.items():
        assert rows[f"standing: {what}"].values == [count]
    assert rows["standing: `ok` and wrong"].values == [1.0]
    assert rows["standing: off where right"].values == [5.0, 5.0]
    assert rows["standing: longest search, processor"].worst == 1.2


def _xy(pose: SE2) -> tuple[float, float, float]:
    return pose.x_m, pose.y_m, pose.theta_rad
