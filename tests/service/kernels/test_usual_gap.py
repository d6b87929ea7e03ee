import numpy as np
import pytest

from service.kernels.usual_gap import usual_gap


@pytest.mark.parametrize(
    ("beams", "gap"),
    [
        ([3, 4, 5, 6, 9, 10, 30, 31], 1),  # each beam is measured, some without a return
        ([0, 4, 8, 10, 12, 14, 16, 20], 2),  # a LUX: coarser at the sides
        ([0, 4, 8, 12, 14, 16, 20, 24], 4),
        ([0, 70, 140, 210], 1),  # too far apart to be neighbours
        ([5], 1),
        ([], 1),
    ],
)
def test_the_usual_gap_is_the_most_common_one(beams: list[int], gap: int) -> None:
    assert usual_gap(np.array(beams, dtype=np.int32)) == gap
