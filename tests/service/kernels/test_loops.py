import numpy as np

from service.geometry.se2 import SE2
from service.kernels.loops import fill_unknown, path_lengths, splat_field
from service.mapper.maps.occupancy import OccupancyRenderer


def lengths(step_m: list[float], of: list[int], to: list[int], start: int) -> np.ndarray:
    out = np.empty(len(step_m) + 1)
    path_lengths(np.array([*step_m, 0.0]), np.array(of, np.int64), np.array(to, np.int64), 1.0, start, out)
    return out


def test_path_lengths_agree_with_floyd_and_warshall():
    random = np.random.default_rng(3)
    for _ in range(10):
        steps = random.uniform(0.1, 2.0, 39)
        of, to = random.integers(0, 40, 5), random.integers(0, 40, 5)
        d = np.full((40, 40), np.inf)
        np.fill_diagonal(d, 0.0)
        for i, step in enumerate(steps):
            d[i, i + 1] = d[i + 1, i] = step
        for a, b in zip(of, to, strict=True):
            if a != b:
                d[a, b] = d[b, a] = min(d[a, b], 1.0)
        for k in range(40):
            d = np.minimum(d, d[:, k : k + 1] + d[k : k + 1])
        for start in (0, 17, 39):
            np.testing.assert_allclose(lengths(steps.tolist(), of.tolist(), to.tolist(), start), d[start])


def test_a_field_is_the_maximum_over_its_points():
    xy = np.random.default_rng(1).uniform(0.3, 1.7, (30, 2))
    field = np.zeros((20, 20), np.float32)
    splat_field(xy, 0, 0, 0.1, 0.12, field)
    centre = (np.arange(20) + 0.5) * 0.1
    dx, dy = centre[None, :, None] - xy[:, 0], centre[:, None, None] - xy[:, 1]
    near = (abs(np.floor(centre / 0.1)[None, :, None] - np.floor(xy[:, 0] / 0.1)) <= 2) & (
        abs(np.floor(centre / 0.1)[:, None, None] - np.floor(xy[:, 1] / 0.1)) <= 2
    )
    expected = np.where(near, np.exp(-0.5 * (dx**2 + dy**2) / 0.12**2), 0.0).max(axis=2)
    np.testing.assert_allclose(field, expected, rtol=1e-5)


def test_only_cells_that_the_map_knows_nothing_of_are_filled():
    canvas = OccupancyRenderer(15.0, 0.1).canvas()
    canvas.draw(np.array([[2.05, 0.05]]), (0.05, 0.05), SE2())
    field = np.zeros((3, 40), np.float32)  # rows -1 to 1, columns -10 to 29
    field[1, 30], field[1, 35] = 0.9, 0.8  # the wall, and something that lies behind it
    fill_unknown(field, -1, -10, canvas.grid(), 0.7)
    seen = field[1, 10:30]  # from the sensor up to the wall
    assert (seen == 0.0).all()
    np.testing.assert_array_equal(field[1, [30, 35]], np.float32([0.9, 0.8]))
    unseen = np.delete(field, np.s_[10:31], axis=1)
    assert (unseen >= np.float32(0.7)).all()
