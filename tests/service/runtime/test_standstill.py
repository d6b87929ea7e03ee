import os

import pytest

from service.runtime import standstill
from service.runtime.standstill import LONG_WORK_S, STUCK_S, MapperSilence, Standstill
from tests.waiting import wait_until


def test_time_counts_again_after_a_word():
    standstill = Standstill()
    wait_until(lambda: standstill.seconds(0)[0] > 0.05)  # no such process
    standstill.reset()
    assert standstill.seconds(0)[0] < 0.05


@pytest.mark.parametrize("is_announced", [False, True])
def test_announced_work_may_take_longer_than_a_scan(monkeypatch: pytest.MonkeyPatch, is_announced: bool):
    """On a busy machine to begin in the map of a large site takes longer than any scan."""
    now_s = [0.0]
    monkeypatch.setattr(standstill.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(standstill, "_now", lambda pid: standstill._Now("R", 0.0))  # waits for a processor
    silence = MapperSilence()
    silence.begin()
    if is_announced:
        silence.announce(has_begun=True)
    most_s = LONG_WORK_S if is_announced else STUCK_S
    for now_s[0] in (0.9 * most_s, 0.99 * most_s):
        assert not silence.is_too_long(os.getpid())
    now_s[0] = 1.01 * most_s
    assert silence.is_too_long(os.getpid())


def test_announced_work_that_computes_without_end_is_too_long(monkeypatch: pytest.MonkeyPatch):
    now_s = [0.0]
    monkeypatch.setattr(standstill.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(standstill, "_now", lambda pid: standstill._Now("R", now_s[0]))
    silence = MapperSilence()
    silence.begin()
    silence.announce(has_begun=True)
    for now_s[0] in (2.0, 20.0, 31.0):
        assert not silence.is_too_long(os.getpid())
    now_s[0] = 33.0  # 31 s after the first look
    assert silence.is_too_long(os.getpid())
