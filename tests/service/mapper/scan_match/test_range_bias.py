"""A laser whose ranges err by a few centimetres, as those of phase-measuring scanners do in waves."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import LaserScan
from service.kernels.range_bias import NODE_M
from service.mapper.profiles import mapping_config
from service.mapper.scan_match.range_bias import NODES
from simulators.trajectory import Limits
from simulators.worlds import WORLDS
from simulators.worlds.mall import mall
from tests.simulated import LMS100_50HZ, Drive, Wheels, drives, run

RANGE_M = NODE_M * np.arange(NODES)


def wave_m(range_m: np.ndarray) -> np.ndarray:
    return 0.03 * np.sin(np.pi * (range_m - 1.35) / 3.25) ** 2


@pytest.fixture(scope="module")
def undisturbed() -> Drive:
    """Two sides of the ring."""
    return drives(WORLDS["ring"](), replace(LMS100_50HZ, rate_hz=12.5), 28.0, [1], Wheels())[0]


def test_ranges_that_err_in_waves_are_learnt_and_taken_out(undisturbed: Drive) -> None:
    biased = [
        replace(frame, range_m=(frame.range_m + wave_m(frame.range_m)).astype(np.float32))
        if isinstance(frame, LaserScan)
        else frame
        for frame in undisturbed.frames
    ]
    done = run(mapping_config(), replace(undisturbed, frames=biased))
    assert done.position_rmse_m < 0.03  # five phases and lengths of the wave: 6 to 23 mm
    curve_m = done.mapper.components.matcher.bias_m("front")
    known = (RANGE_M >= 1.0) & (RANGE_M <= 4.0)
    off_m = (curve_m - wave_m(RANGE_M))[known]
    assert np.std(off_m) < 0.004
    false = np.hypot(*done.errors[:, :2].T) > 0.3
    assert not any(output.state == "ok" for output, is_off in zip(done.outputs, false, strict=True) if is_off)


def test_ranges_that_are_all_too_long_by_the_same_are_learnt_and_taken_out_of_the_map() -> None:
    """30 mm in an office, of which the first metres are mapped with walls that much too far away."""
    laser = replace(LMS100_50HZ, rate_hz=12.5, model=replace(LMS100_50HZ.model, bias_m=0.03))
    (made,) = drives(WORLDS["office"](), laser, 28.0, [1], Wheels())
    done = run(mapping_config(), made)
    curve_m = done.mapper.components.matcher.bias_m("front")
    np.testing.assert_allclose(curve_m[(RANGE_M >= 1.0) & (RANGE_M <= 4.0)], 0.03, atol=0.005)
    assert done.position_rmse_m < 0.025


def test_people_who_walk_along_teach_nothing_of_ranges() -> None:
    """Who walks ahead stands each time behind where he stood: ranges of 1 m would seem 5 cm too long."""
    world = mall(Limits(speed_mps=3.0, acceleration_mps2=1.0, lateral_mps2=1.2))
    (made,) = drives(world, replace(LMS100_50HZ, rate_hz=12.5), 25.0, [1], Wheels())
    done = run(mapping_config(), made)
    curve_m = done.mapper.components.matcher.bias_m("front")
    assert np.abs(curve_m[RANGE_M <= 8.0]).max() < 0.003
