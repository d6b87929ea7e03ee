from service.allowance import Allowance
from tests.set_clock import SetClock


def test_so_many_at_once_then_so_many_a_second_and_all_at_once_after_a_rest():
    clock = SetClock()
    allowance = Allowance(10.0, 3.0, clock)
    assert [allowance.takes_one() for _ in range(5)] == [True] * 3 + [False] * 2
    taken = 0
    for _ in range(1000):  # a flood of 1000 a second for a second
        clock.now_s += 0.001
        taken += allowance.takes_one()
    assert 9 <= taken <= 10
    clock.now_s += 60.0
    assert [allowance.takes_one() for _ in range(4)] == [True] * 3 + [False]
