"""A filter in two arrays is the filter in its own."""

import numpy as np

from service.kernels.filter_state import COVARIANCE, NUMBERS, STAMPS, PackedFilter, views_of


def arrays_of(packed: PackedFilter) -> list[np.ndarray]:
    state = views_of(packed)
    return [array for field in state for array in (field if isinstance(field, tuple) else (field,))]


def test_each_number_belongs_to_one_array() -> None:
    packed = PackedFilter(np.zeros(NUMBERS), np.zeros(STAMPS, np.int64))
    for array in arrays_of(packed):
        array += 1
    assert np.all(packed.numbers == 1.0)
    assert np.all(packed.stamps == 1)


def test_the_covariance_is_the_last() -> None:
    packed = PackedFilter(np.arange(float(NUMBERS)), np.zeros(STAMPS, np.int64))
    covariance = views_of(packed).covariance
    assert np.array_equal(covariance.ravel(), packed.numbers[COVARIANCE:])
    assert covariance[0, 1] == COVARIANCE + 1
