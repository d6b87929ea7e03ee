import math

import numpy as np
import pytest

from service.kernels.normals import ROUGH_WEIGHT, estimate_normals, range_noise

STEP_RAD = math.radians(0.5)
SIGMA_M = 0.01


def normals_of(
    xy: np.ndarray, sensor: tuple[float, float] = (0.0, 0.0), sigma_m: float = SIGMA_M
) -> np.ndarray:
    return walls_at(xy, sensor, sigma_m)[0]


def walls_at(
    xy: np.ndarray,
    sensor: tuple[float, float] = (0.0, 0.0),
    sigma_m: float = SIGMA_M,
    step_rad: float = STEP_RAD,
) -> tuple[np.ndarray, np.ndarray]:
    """Normals, and the points moved along their walls."""
    normals, moved = np.full((len(xy), 3), np.nan), np.full((len(xy), 2), np.nan)
    estimate_normals(np.ascontiguousarray(xy), np.array(sensor), step_rad, sigma_m, 5.0, normals, moved)
    return normals, moved


def wall(distance_m: float, angles: np.ndarray) -> np.ndarray:
    """A wall at x = distance_m as beams at these angles hit it."""
    return np.column_stack([np.full(len(angles), distance_m), distance_m * np.tan(angles)])


def test_a_wall_faces_the_sensor() -> None:
    normals = normals_of(wall(3.0, np.arange(-0.5, 0.5, STEP_RAD)), sigma_m=1e-4)
    np.testing.assert_allclose(normals[:, :2], [[-1.0, 0.0]] * len(normals), atol=1e-4)
    assert normals[len(normals) // 2, 2] == pytest.approx(1.0, abs=1e-3)  # head-on
    cosine = np.cos(np.arange(-0.5, 0.5, STEP_RAD))
    np.testing.assert_allclose(normals[:, 2], 1.0 / (0.2 + 0.8 * cosine**2), rtol=1e-4)


def along_a_corridor(depth_m: float, sigma_m: float = 0.0, end_m: float = 8.0) -> np.ndarray:
    """The wall 1 m beside the sensor up to 14 m ahead, as beams see it; from 7 to `end_m` it lies deeper."""
    angles = np.arange(math.pi / 2.0 - STEP_RAD, math.atan2(1.0, 14.0), -STEP_RAD)
    range_m = 1.0 / np.sin(angles)
    deeper_m = (1.0 + depth_m) / np.sin(angles)
    at_m = deeper_m * np.cos(angles)
    range_m = np.where((at_m > 7.0) & (at_m < end_m), deeper_m, range_m)
    range_m += np.random.default_rng(3).normal(0.0, sigma_m, len(angles))
    return range_m[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])


def test_beams_that_graze_a_wall_see_it_in_long_steps() -> None:
    """From 6 m on their points are as far apart as those of two walls elsewhere; up to 1 m it is one wall."""
    xy = along_a_corridor(0.0, SIGMA_M)
    normals = normals_of(xy)
    step_m = np.hypot(*np.diff(xy, axis=0).T)
    is_far = (xy[:-1, 0] > 6.5) & (step_m < 0.85)
    assert is_far.sum() == 5
    assert (normals[:-1][is_far, 2] > 1.0).all()
    np.testing.assert_allclose(normals[:-1][is_far, :2], [[0.0, -1.0]] * is_far.sum(), atol=0.01)
    assert (normals[1:][step_m > 1.05, 2] == ROUGH_WEIGHT).all()


def test_a_recess_is_no_plane_however_long_the_row_of_points() -> None:
    """A sunk door far ahead along a corridor: none of its points turns the wall, nor is turned by it."""
    xy = along_a_corridor(0.2)
    normals = normals_of(xy)
    across_m = np.abs(xy[:, 1] - 1.0)
    assert (across_m > 0.1).sum() >= 2
    assert (normals[across_m > 0.1, 2] <= ROUGH_WEIGHT).all()
    planar = normals[:, 2] >= 1.0
    np.testing.assert_allclose(normals[planar, :2], [[0.0, -1.0]] * planar.sum(), atol=0.03)


def test_a_beam_that_ends_between_two_walls_does_not_join_them() -> None:
    """At the edge of a door close by, beside the wall's points and in line with the first of the door's."""
    angles = np.arange(-1.35, -0.9, STEP_RAD)
    range_m = np.where(angles > -1.15, 1.0, 1.25) / np.sin(-angles)
    edge = int(np.flatnonzero(angles > -1.15)[0])
    range_m[edge] = 0.5 * (range_m[edge - 1] + range_m[edge + 1])
    normals = normals_of(range_m[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]))
    beside = np.r_[normals[edge - 12 : edge - 1], normals[edge + 2 : edge + 12]]
    np.testing.assert_allclose(beside[:, :2], [[0.0, 1.0]] * len(beside), atol=0.1)
    assert (beside[:, 2] >= 1.0).all()


def test_grazing_beams_are_dropped() -> None:
    y = np.arange(10.0, 10.5, 0.02)
    normals = normals_of(np.column_stack([np.full(len(y), 0.2), y]))
    np.testing.assert_array_equal(normals[:, 2], 0.0)


def test_lone_points_are_rough_and_face_the_sensor() -> None:
    normals = normals_of(np.array([[2.0, 0.0], [0.0, 3.0], [-4.0, 0.0]]))
    expected = [[-1, 0, ROUGH_WEIGHT], [0, -1, ROUGH_WEIGHT], [1, 0, ROUGH_WEIGHT]]
    np.testing.assert_allclose(normals, expected, atol=1e-12)


def test_no_points_give_no_normals() -> None:
    assert len(normals_of(np.empty((0, 2)))) == 0


def noisy_wall(distance_m: float, sigma_m: float, seed: int = 0) -> np.ndarray:
    angles = np.arange(-0.6, 0.6, STEP_RAD)
    ranges = distance_m / np.cos(angles) + sigma_m * np.random.default_rng(seed).standard_normal(len(angles))
    return ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])


def test_a_noisy_laser_looks_at_more_of_a_wall() -> None:
    """Near by, where four beams each side span 20 cm, its normals would else be off by half a radian."""
    xy = noisy_wall(1.5, 0.03)
    middle = slice(20, -20)

    def error_rad(sigma_m: float) -> float:
        normals = normals_of(xy, sigma_m=sigma_m)[middle]
        return float(np.sqrt(np.mean(np.arctan2(normals[:, 1], -normals[:, 0]) ** 2)))

    assert error_rad(0.03) < 0.15
    assert error_rad(0.003) > 0.25


def test_a_wall_may_be_as_thick_as_noise_makes_it_and_no_thicker() -> None:
    xy = noisy_wall(3.0, 0.03)
    assert (normals_of(xy, sigma_m=0.03)[20:-20, 2] >= 1.0).mean() > 0.9
    assert (normals_of(xy, sigma_m=0.01)[20:-20, 2] >= 1.0).mean() < 0.1


@pytest.mark.parametrize("across_m", [1.0, 1.5])
def test_a_wall_seen_aslant_is_not_turned_by_noise(across_m: float) -> None:
    """Noise along slanting beams tilts a line through their points by up to 30 mrad; moving along a corridor
    the tilt moves with the vehicle, and holds it back."""
    angles = np.arange(0.3, 1.2, STEP_RAD)
    rng = np.random.default_rng(2)
    tilt_rad = []
    for _ in range(400):
        ranges = across_m / np.cos(angles) + rng.normal(0.0, SIGMA_M, len(angles))
        normals = normals_of(ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]))
        tilt_rad.append(np.arctan2(normals[15:-15, 1], -normals[15:-15, 0]))
    assert abs(np.mean(tilt_rad)) < 5e-4


@pytest.mark.parametrize("distance_m", [0.9, 1.0, 1.1, 2.0])
def test_a_point_that_is_off_does_not_choose_whether_it_counts(distance_m: float) -> None:
    """Else those that count lie nearer than the wall: 2 mm at a sigma of 10."""
    off_m = []
    for seed in range(100):
        xy = noisy_wall(distance_m, SIGMA_M, seed)
        head_on = slice(len(xy) // 2 - 10, len(xy) // 2 + 10)
        is_planar = normals_of(xy)[head_on, 2] >= 1.0
        assert is_planar.mean() > 0.5
        off_m.append(xy[head_on, 0][is_planar] - distance_m)
    assert abs(np.mean(np.concatenate(off_m))) < 0.0007


@pytest.mark.parametrize("sigma_m", [0.003, 0.01, 0.03])
def test_the_noise_of_ranges_is_seen_in_a_scan_with_edges(sigma_m: float) -> None:
    near, far = noisy_wall(2.0, sigma_m, seed=1), noisy_wall(4.0, sigma_m, seed=2)
    beams = np.arange(len(near), dtype=np.int32)
    xy = np.where((beams % 40 < 12)[:, None], near, far)  # edges on every side
    seen = [
        range_noise(
            np.vstack([xy, noisy_wall(3.0, sigma_m, seed)]),
            np.arange(2 * len(xy), dtype=np.int32),
            np.zeros(2),
        )
        for seed in range(10, 30)
    ]
    assert np.mean(seen) == pytest.approx(sigma_m, rel=0.15)


def test_beams_that_are_no_neighbours_show_no_noise() -> None:
    xy = noisy_wall(3.0, 0.01)
    assert range_noise(xy, np.arange(0, 5 * len(xy), 5, dtype=np.int32), np.zeros(2)) == 0.0
    assert range_noise(xy[:31], np.arange(31, dtype=np.int32), np.zeros(2)) == 0.0
    assert range_noise(xy[:32], np.arange(32, dtype=np.int32), np.zeros(2)) > 0.0


def sunk_door(depth_m: float, step_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """A wall along x, 1.3 m to the left, with a door from x = 2 m to 3 m that lies `depth_m` deeper, as beams
    see it from the origin, and which of them end on the far side of the door.
    """
    points, is_side = [], []
    for angle in np.arange(math.radians(15.0), math.radians(80.0), step_rad):
        c, s = math.cos(angle), math.sin(angle)
        on_wall, on_door, on_side = 1.3 / s, (1.3 + depth_m) / s, 3.0 / c
        if not 2.0 < on_wall * c < 3.0:
            range_m, side = on_wall, False
        elif on_door * c < 3.0:
            range_m, side = on_door, False
        else:
            range_m, side = on_side, True
        points.append((range_m * c, range_m * s))
        is_side.append(side)
    return np.array(points), np.array(is_side)


def test_the_side_of_a_door_is_a_plane_for_a_laser_of_one_degree() -> None:
    """It alone fixes the position along a corridor; a window around its points holds the walls beside too."""
    step_rad = math.radians(1.0)
    planar, moved, off_rad = 0, 0, []
    for seed in range(20):
        xy, is_side = sunk_door(0.2, step_rad)
        towards = xy / np.hypot(*xy.T)[:, None]
        xy = xy + towards * np.random.default_rng(seed).normal(0.0, SIGMA_M, len(xy))[:, None]
        normals, there = walls_at(xy, step_rad=step_rad)
        of_side = normals[is_side & (normals[:, 2] > 0.5)]
        moved += int((there != xy)[is_side & (normals[:, 2] > 0.5)].any(axis=1).sum())
        planar += len(of_side)
        off_rad += list(np.arctan2(of_side[:, 1], -of_side[:, 0]))
    assert is_side.sum() == 3
    assert planar >= 0.5 * 20 * is_side.sum()
    assert moved == planar
    assert np.mean(np.abs(off_rad) < 0.5) > 0.8


def test_few_far_points_make_no_plane_beside_an_edge() -> None:
    """Of a stair of walls that are each hit once, any three points may lie in line."""
    angles = np.arange(-0.5, 0.5, math.radians(2.0))
    range_m = 4.0 + 0.5 * (np.arange(len(angles)) % 2) * np.linspace(0.2, 1.0, len(angles))
    xy = np.column_stack([range_m * np.cos(angles), range_m * np.sin(angles)])
    normals, _ = walls_at(xy, step_rad=math.radians(2.0))
    assert (normals[:, 2] <= ROUGH_WEIGHT).all()


def test_a_wall_that_ends_far_ahead_is_not_joined_to_the_next() -> None:
    """Where it lies 18 cm deeper, its last points and the first of the other wall come in steps alike."""
    xy = along_a_corridor(0.18, end_m=10.3)
    normals = normals_of(xy)
    is_deep = xy[:, 1] > 1.1
    assert is_deep.sum() >= 4
    assert (normals[is_deep, 2] > 1.0).all()
    np.testing.assert_allclose(normals[is_deep, :2], [[0.0, -1.0]] * is_deep.sum(), atol=0.01)


def test_noise_is_seen_where_only_every_second_beam_or_every_fourth_comes_back() -> None:
    xy = noisy_wall(3.0, 0.04)
    dense = range_noise(xy, np.arange(len(xy), dtype=np.int32), np.zeros(2))
    for gap in (2, 3, 4):
        assert range_noise(xy, np.arange(0, gap * len(xy), gap, dtype=np.int32), np.zeros(2)) == dense


def test_noise_parts_no_wall_that_is_seen_aslant() -> None:
    """A LUX errs by 4 cm, so by 12 cm between two beams at times; a split wall has less certain normals."""
    angles = np.radians(np.arange(-55.0, 55.0, 0.5))
    noise = np.random.default_rng(5)
    planar = []
    for _ in range(20):
        range_m = 1.1 / np.cos(angles) + noise.normal(0.0, 0.04, len(angles))
        xy = range_m[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        planar.append((normals_of(xy, sigma_m=0.04)[:, 2] >= 1.0).mean())
    assert np.mean(planar) > 0.95  # 0.85 where 6 cm are a gap


def test_grazed_points_with_lost_beams_between_are_of_no_known_wall() -> None:
    xy = along_a_corridor(0.0)
    every_second = np.delete(xy, np.flatnonzero(xy[:, 0] > 3.0)[1::2], axis=0)
    step_m = np.hypot(*np.diff(every_second, axis=0).T)
    is_far = (every_second[:-1, 0] > 4.5) & (step_m < 0.9)
    assert is_far.sum() >= 4
    assert (normals_of(every_second)[:-1][is_far, 2] == ROUGH_WEIGHT).all()


@pytest.mark.parametrize(("sigma_m", "least"), [(0.012, 0.25), (0.04, 0.6)])
def test_noise_along_the_beam_is_taken_out_along_the_wall_and_left_across_it(
    sigma_m: float, least: float
) -> None:
    """The bearing determines where along the wall a beam ends."""
    angles = np.radians(np.arange(-60.0, 60.0, 0.5))
    noise_m = np.random.default_rng(4).normal(0.0, sigma_m, (40, len(angles)))
    along, moved, across = [], [], []
    for of_scan_m in noise_m:
        range_m = 1.5 / np.cos(angles) + of_scan_m
        xy = range_m[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        normals, there = walls_at(xy, sigma_m=sigma_m)
        assert (there == xy)[normals[:, 2] < 0.5].all()
        aslant = (np.abs(angles) > 0.6) & (normals[:, 2] >= 1.0)
        along += list((xy[:, 1] - 1.5 * np.tan(angles))[aslant])
        moved += list((there[:, 1] - 1.5 * np.tan(angles))[aslant])
        across += list((there - xy)[aslant, 0])
    assert len(along) > 1500
    assert np.var(moved) < (1.0 - least) * np.var(along)
    assert np.std(across) < 0.1 * np.std(along)
