import numpy as np

from service.kernels.wall_groups import group_by_wall

NOISE_M = 0.012


def wall(rng: np.random.Generator, begin: tuple[float, float], end: tuple[float, float]) -> np.ndarray:
    """(N, 5) points of a wall each 4 cm, and normals 0.05 rad off, to the left of its direction."""
    direction = np.subtract(end, begin)
    length_m = float(np.hypot(*direction))
    along = np.arange(0.0, length_m, 0.04) / length_m
    left = np.array([-direction[1], direction[0]]) / length_m
    xy = begin + along[:, None] * direction + NOISE_M * rng.standard_normal((len(along), 1)) * left
    angle = np.arctan2(left[1], left[0]) + 0.05 * rng.standard_normal(len(along))
    return np.column_stack((xy, np.cos(angle), np.sin(angle), np.ones(len(along))))


def grouped(*parts: np.ndarray) -> list[set[int]]:
    """The groups that the points of each part are in."""
    points = np.concatenate(parts)
    order = np.random.default_rng(2).permutation(len(points))
    group = np.empty(len(points), np.int64)
    xy, normals = points[order, :2].copy(), points[order, 2:].copy()
    count = group_by_wall(xy, normals, np.full(len(points), NOISE_M), group)
    assert set(group.tolist()) == set(range(count))
    of = np.empty(len(points), np.int64)
    of[order] = group
    return [set(part.tolist()) for part in np.split(of, np.cumsum([len(part) for part in parts])[:-1])]


def test_a_wall_is_one_however_long_and_beyond_a_door_and_another_one_is_not() -> None:
    rng = np.random.default_rng(1)
    far_end, beyond_door = wall(rng, (0.0, 1.0), (12.0, 1.0)), wall(rng, (13.0, 1.0), (20.0, 1.0))
    niche, across = wall(rng, (12.0, 1.4), (13.0, 1.4)), wall(rng, (20.0, 1.0), (20.0, -1.0))
    first, second, third, fourth = grouped(far_end, beyond_door, niche, across)
    assert len(first | second) <= 2  # a stray normal or two
    assert first & second
    assert not (first | second) & (third | fourth)
    assert not third & fourth


def test_both_sides_of_a_thin_wall_are_two() -> None:
    rng = np.random.default_rng(1)
    one, other = grouped(wall(rng, (0.0, 0.0), (5.0, 0.0)), wall(rng, (5.0, -0.04), (0.0, -0.04)))
    assert not one & other
