"""The listener of the log of one cycle: what goes in and out of a part, unchanged by what comes later."""

import numpy as np

from tests.papers import one_cycle
from tests.papers.one_cycle import listening


def test_a_call_is_kept_as_it_was_given_and_as_it_came_back() -> None:
    real = one_cycle.farthest
    with listening(one_cycle, "farthest") as heard:
        xy = np.zeros((2, 2))
        assert one_cycle.farthest(xy, np.array([[3.0, 4.0], [0.0, 1.0]])) == 5.0
        xy += 7.0
    assert one_cycle.farthest is real
    (call,) = heard
    np.testing.assert_array_equal(call.given[0], np.zeros((2, 2)))
    np.testing.assert_array_equal(call.changed[0], np.zeros((2, 2)))
    assert call.gave == 5.0


def test_what_a_part_changes_is_told_apart_from_what_it_was_given(monkeypatch) -> None:
    def raise_by_one(xy: np.ndarray) -> None:
        xy += 1.0

    monkeypatch.setattr(one_cycle, "farthest", raise_by_one)
    with listening(one_cycle, "farthest") as heard:
        one_cycle.farthest(np.zeros(3))
    np.testing.assert_array_equal(heard[0].given[0], np.zeros(3))
    np.testing.assert_array_equal(heard[0].changed[0], np.ones(3))
