from service.geometry.se2 import SE2
from service.mapper.matchers.recovery import Confirmation

FOUND, PREDICTED = SE2(5.0, 1.0, 0.3), SE2(1.0, 0.0, 0.0)
STEP = SE2(0.4, 0.0, 0.1)  # of the vehicle, from one find to the next


def test_a_find_counts_when_the_next_one_agrees() -> None:
    confirmation = Confirmation()
    assert not confirmation.confirms(FOUND, PREDICTED)
    assert confirmation.confirms(FOUND @ STEP, PREDICTED @ STEP)
    assert not confirmation.confirms(FOUND @ SE2(0.0, 0.4, 0.0), PREDICTED @ STEP)


def test_a_result_that_was_cleared_confirms_nothing() -> None:
    confirmation = Confirmation()
    confirmation.confirms(FOUND, PREDICTED)
    confirmation.clear()
    assert not confirmation.confirms(FOUND @ STEP, PREDICTED @ STEP)
