"""Messages between processes: whole, in order, without waiting, and with an end that is heard of."""

import socket

import pytest

from service.runtime import channel
from service.runtime.channel import Channel, ChannelClosedError, wait_for
from tests.in_background import started


def pair() -> tuple[Channel, Channel]:
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    return Channel(a), Channel(b)


def test_a_sender_never_waits_and_what_the_socket_does_not_take_comes_all_the_same():
    ours, theirs = pair()
    messages = [(k, b"x" * 100_000) for k in range(100)]
    for message in messages:
        ours.send(message)
    assert ours.waiting_bytes > 0
    heard: list[object] = []
    while len(heard) < len(messages):
        wait_for([ours, theirs], 1.0)  # sends what waits meanwhile
        heard += theirs.receive()
    assert heard == messages
    assert ours.flush()
    ours.close()
    theirs.close()


def test_an_end_that_breaks_while_it_is_sent_to_is_reported_to_who_receives_next():
    class Broken:
        """Can be written to, as the socket says, and then cannot."""

        waiting_bytes = 1

        def __init__(self) -> None:
            self.other, self.socket = socket.socketpair()

        def fileno(self) -> int:
            return self.socket.fileno()

        def flush(self) -> bool:
            raise ChannelClosedError("broken pipe")

    broken = Broken()
    assert wait_for([broken], 1.0) == [broken]
    broken.other.close()
    broken.socket.close()


def test_a_reader_that_stands_still_is_given_up_before_memory_is_full(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(channel, "MAX_WAITING_BYTES", 1_000_000)
    ours, theirs = pair()
    while ours.waiting_bytes <= channel.MAX_WAITING_BYTES:
        ours.send(b"x" * 100_000)
    with pytest.raises(ChannelClosedError, match="stands still"):
        ours.send(b"x")
    ours.close()
    theirs.close()


def test_threads_that_send_do_not_mix_their_messages():
    ours, theirs = pair()
    senders = [started(lambda k=k: [ours.send((k, i)) for i in range(300)]) for k in range(4)]
    heard: list[tuple[int, int]] = []
    while len(heard) < 1200:
        wait_for([ours, theirs], 1.0)
        heard += theirs.receive()
    for sender in senders:
        sender.result(10.0)
    for k in range(4):
        assert [i for who, i in heard if who == k] == list(range(300))
    ours.close()
    theirs.close()
