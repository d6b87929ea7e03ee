import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from service.kernels import ordering
from tests.service.kernels.inner import from_python

kth_smallest = from_python(ordering.kth_smallest)
order_rising = from_python(ordering.order_rising)

NUMBERS = st.lists(st.sampled_from((-2.0, -0.0, 0.0, 1.0, 1.5, np.inf)) | st.floats(-5.0, 5.0), max_size=40)


@settings(deadline=None)  # the first call compiles
@given(NUMBERS)
def test_order_is_that_of_a_stable_sort(numbers: list[float]) -> None:
    values = np.array(numbers, dtype=float)
    order = np.empty(len(values), np.int64)
    order_rising(values, order)
    assert order.tolist() == np.argsort(values, kind="stable").tolist()


@settings(deadline=None)  # the first call compiles
@given(NUMBERS.filter(len), st.integers(0, 39), st.integers(0, 5))
def test_the_kth_smallest_is_that_of_the_sorted_row(numbers: list[float], k: int, unused: int) -> None:
    k %= len(numbers)
    values = np.array(numbers + [-9.0] * unused)
    assert kth_smallest(values, len(numbers), k) == sorted(numbers)[k]
