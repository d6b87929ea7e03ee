import os
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import pytest
from numba import njit

from service import kernel_warm_up
from service.kernel_warm_up import warm_up


def helps(theirs: Connection, section: object) -> None:
    theirs.send(True)
    while theirs.recv() is not None:
        theirs.send(True)


def dies(theirs: Connection, section: object) -> None:
    theirs.send(True)
    theirs.recv()
    os._exit(3)


def compile_something() -> None:
    njit(lambda x: x + 1)(1)


@pytest.mark.parametrize(
    ("help_", "warning"), [(helps, ""), (dies, "ended with code 3; its part is compiled here")]
)
def test_what_the_helper_took_is_loaded_here_or_compiled_if_it_died(
    help_: Callable[..., None],
    warning: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):
    done: list[int] = []
    taken = threading.Event()
    claim = kernel_warm_up._Pieces.claim

    def claim_and_tell(self: Any) -> int | None:
        piece = claim(self)
        if threading.current_thread() is not threading.main_thread():
            taken.set()
        return piece

    def first() -> None:
        compile_something()
        assert taken.wait(60.0)
        done.append(0)

    monkeypatch.setattr(kernel_warm_up._Pieces, "claim", claim_and_tell)
    monkeypatch.setattr(
        kernel_warm_up, "rehearsals", lambda config: [first, lambda: done.append(1), lambda: done.append(2)]
    )
    monkeypatch.setattr(kernel_warm_up, "_help", help_)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    warm_up()
    assert sorted(done) == [0, 1, 2]
    assert done.index(0) < done.index(1)
    assert warning in caplog.text
    assert bool(warning) == bool(caplog.text)


def test_nobody_helps_where_all_is_in_the_cache(monkeypatch: pytest.MonkeyPatch):
    done: list[int] = []
    monkeypatch.setattr(kernel_warm_up, "rehearsals", lambda config: [lambda: done.append(0)] * 2)
    monkeypatch.setattr(kernel_warm_up, "get_context", lambda method: pytest.fail("a process was begun"))
    warm_up()
    assert done == [0, 0]


def test_what_does_not_compile_is_raised(monkeypatch: pytest.MonkeyPatch):
    def broken() -> None:
        raise TypeError("cannot lower")

    monkeypatch.setattr(kernel_warm_up, "rehearsals", lambda config: [broken])
    with pytest.raises(TypeError, match="cannot lower"):
        warm_up()
