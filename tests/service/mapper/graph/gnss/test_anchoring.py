"""Fixes that anchor a drive outdoors; whatever is wrong with one moves nothing."""

import math
from dataclasses import replace
from itertools import starmap

import numpy as np
import pytest

from service.geometry.geo_reference import LocalFrame
from service.mapper.graph.loops.loop_back_end import Result
from tests.gnss_receiver import GnssModel, Reflection
from tests.service.mapper.graph.gnss.outdoors import (
    ORIGIN,
    YAW_RAD,
    Outing,
    ate_m,
    errors_m,
    fed,
    outing,
    with_fixes,
)
from tests.soaked import in_soak

PATH_LENGTH_M = 450.0
LONG_M = 700.0  # on which drift is more than fixes err by


@pytest.fixture(scope="module")
def drive() -> Outing:
    return outing(PATH_LENGTH_M, seed=1, turn_walk_rad=0.001)


@pytest.fixture(scope="module")
def results(drive: Outing) -> list[Result]:
    return fed(drive)[1]


@pytest.fixture(scope="module")
def anchored(results: list[Result]) -> Result:
    return results[-1]


@pytest.fixture(scope="module")
def bare(drive: Outing) -> Result:
    """The same drive without a fix."""
    return fed(replace(drive, fixes=[]))[1][-1]


def places(result: Result) -> np.ndarray:
    return np.array([(c.pose_map_base.x_m, c.pose_map_base.y_m) for c in result.all])


def moved_m(a: Result, b: Result) -> float:
    """Largest difference of a key frame's position in the map or on the earth."""
    assert a.geo is not None
    assert b.geo is not None
    on_earth = [
        np.array([ORIGIN.to_enu(*r.geo.to_geodetic(*xy), 51.7)[:2] for xy in places(r)])
        for r in (a, b)
        if r.geo
    ]
    return float(
        max(np.hypot(*(places(a) - places(b)).T).max(), np.hypot(*(on_earth[0] - on_earth[1]).T).max())
    )


def test_fixes_correct_a_drifting_path_and_give_its_reference():
    drive = outing(LONG_M, seed=1, turn_walk_rad=0.001)
    anchored, bare = (fed(what)[1][-1] for what in (drive, replace(drive, fixes=[])))
    assert bare.geo is None
    assert bare.fixes == {}
    assert ate_m(anchored, drive) < 0.7 * ate_m(bare, drive)
    assert errors_m(anchored, drive).max() < 3.5
    assert anchored.geo is not None
    assert anchored.geo.fixes == anchored.fixes["fixes_anchoring"] > 100
    turned_rad = anchored.geo.pose_enu_map.theta_rad - YAW_RAD
    assert abs(turned_rad) < 3.0 * anchored.geo.yaw_sigma_rad < math.radians(6.0)
    assert anchored.g2o.count("VERTEX_SE2") == len(drive.frames) + 1


@pytest.mark.parametrize(
    "useless",
    [
        {"status": -1},
        {"covariance": (0.0,) * 9},
        {"covariance": (math.nan,) * 9},
        {"covariance": (400.0, 0, 0, 0, 400.0, 0, 0, 0, 900.0)},
        {"latitude_deg": 60.161, "longitude_deg": 24.546},  # frozen receiver
    ],
)
def test_uninformative_fixes_change_nothing_to_the_last_bit(drive: Outing, bare: Result, useless):
    result = fed(with_fixes(drive, lambda fix: replace(fix, **useless)))[1][-1]
    assert result.geo is None
    assert result.all == bare.all
    assert result.g2o == bare.g2o


def without(drive: Outing, wrong: range) -> Result:
    return fed(replace(drive, fixes=[fix for k, fix in enumerate(drive.fixes) if k not in wrong]))[1][-1]


@pytest.mark.parametrize(
    ("fault", "wrong"),
    [
        in_soak(lambda fix: replace(fix, latitude_deg=fix.latitude_deg + 50.0 / 111_200.0), range(800, 840)),
        (lambda fix: replace(fix, latitude_deg=fix.latitude_deg + 50.0 / 111_200.0), range(0, 60)),
        (lambda fix: replace(fix, latitude_deg=-fix.latitude_deg), range(800, 820)),
        in_soak(lambda fix: replace(fix, longitude_deg=-fix.longitude_deg), range(0, 30)),
        in_soak(lambda fix: replace(fix, latitude_deg=0.0, longitude_deg=0.0), range(0, 30)),
    ],
    ids=["jump of 50 m", "jump at the start", "sign of latitude", "first fixes in the west", "zeros"],
)
def test_a_jump_and_a_swapped_sign_move_nothing(drive: Outing, fault, wrong):
    fixes = [fault(fix) if k in wrong else fix for k, fix in enumerate(drive.fixes)]
    result = fed(replace(drive, fixes=fixes))[1][-1]
    assert result.fixes["fixes_contradicting"] > 0
    assert moved_m(result, without(drive, wrong)) < 0.5  # other fixes are kept beside those
    assert errors_m(result, drive).max() < 5.0


@pytest.fixture(scope="module")
def hidden() -> Result:
    """A minute without fixes."""
    outage = GnssModel(outages=[(200.0, 260.0)])
    return fed(outing(PATH_LENGTH_M, 1, outage, turn_walk_rad=0.001))[1][-1]


@pytest.mark.parametrize(
    ("direction_rad", "size_m"),
    [(0.4, 5.0), *starmap(in_soak, [(0.4, 8.0), (0.4, 15.0), (3.5, 5.0), (3.5, 8.0), (3.5, 15.0)])],
)
def test_a_minute_of_reflections_moves_nothing(direction_rad, size_m, hidden: Result):
    off = size_m * math.cos(direction_rad), size_m * math.sin(direction_rad)
    model = GnssModel(reflections=[Reflection(200.0, 260.0, *off)])
    reflected = outing(PATH_LENGTH_M, 1, model, turn_walk_rad=0.001)
    result = fed(reflected)[1][-1]
    assert result.fixes["fixes_contradicting"] >= 15
    assert moved_m(result, hidden) < 0.2


def test_fixes_inconsistent_with_the_path_give_no_reference(drive: Outing, bare: Result):
    noise = np.random.default_rng(2)
    elsewhere = LocalFrame(60.161, 24.546, 51.7)

    def wild(fix):
        latitude_deg, longitude_deg = elsewhere.on_ground(*(300.0 * noise.standard_normal(2)))
        return replace(fix, latitude_deg=latitude_deg, longitude_deg=longitude_deg)

    result = fed(with_fixes(drive, wild))[1][-1]
    assert result.geo is None
    assert result.fixes["fixes_contradicting"] > 50
    assert result.all == bare.all


def test_the_reference_comes_once_the_direction_is_known_and_stays(results: list[Result]):
    known = [result.geo is not None for result in results]
    first = known.index(True)
    assert all(known[first:])
    assert 60.0 < 6.0 * first < 250.0  # m: 20 key frames a batch
    assert not any(r.newest for r in results[:first])
    assert results[first].newest
    assert {r.geo.origin for r in results[first:] if r.geo} == {results[first].geo.origin}
