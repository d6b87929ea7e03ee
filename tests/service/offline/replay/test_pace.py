import threading

from service.offline.replay.pace import Pace
from tests.in_background import started

S = 1_000_000_000
TIMEOUT_S = 20.0


class Steps:
    """Steps of a replay, one each tenth of a second of log time, in a thread of its own."""

    def __init__(self, pace: Pace, count: int = 50) -> None:
        self.taken: list[int] = []
        self.held = threading.Event()  # the next step has to wait
        self._stepping = started(lambda: self._run(pace, count))

    def _run(self, pace: Pace, count: int) -> None:
        for tenth in range(count):
            pace.wait_for(tenth * S // 10, self.held.set)
            self.taken.append(tenth)

    def wait_held(self) -> int:
        """How many were taken when the next one had to wait."""
        assert self.held.wait(TIMEOUT_S)
        self.held.clear()
        return len(self.taken)

    def wait_ended(self) -> None:
        self._stepping.result(TIMEOUT_S)


def test_it_begins_paused_goes_to_a_time_and_pauses_there() -> None:
    pace = Pace(0.0, is_paused=True)
    steps = Steps(pace)
    assert steps.wait_held() == 0
    assert pace.is_paused
    pace.go_to(2 * S)
    assert steps.wait_held() == 20  # the step at 2 s is yet to be taken
    assert pace.is_paused
    pace.resume()
    steps.wait_ended()
    assert steps.taken == list(range(50))


def test_a_change_of_the_rate_holds_from_there_on() -> None:
    pace = Pace(1e-6)  # days
    steps = Steps(pace)
    assert steps.wait_held() == 1
    pace.set_rate(1e6)
    steps.wait_ended()
