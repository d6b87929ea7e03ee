from service.runtime.standstill import Standstill
from tests.waiting import wait_until


def test_time_counts_again_after_a_word():
    standstill = Standstill()
    wait_until(lambda: standstill.seconds(0)[0] > 0.05)  # no such process
    standstill.reset()
    assert standstill.seconds(0)[0] < 0.05
