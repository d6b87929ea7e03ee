from collections.abc import Generator
from dataclasses import dataclass

from drivers.dialogue import DialogueRunner, Pause

S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Ask:
    word: str
    timeout_s: float = 1.0


Steps = Generator[Ask | Pause, str | None, None]


def runner_of(*steps: Ask | Pause) -> tuple[DialogueRunner[Ask, str], list[str | None]]:
    """A runner of these steps, and what the dialogue is sent after each."""
    sent: list[str | None] = []

    def dialogue() -> Steps:
        for step in steps:
            sent.append((yield step))

    return DialogueRunner(dialogue), sent


def test_the_time_out_counts_from_the_tick_that_sent_not_from_the_answer_before():
    runner, sent = runner_of(Ask("who"), Ask("where"))
    runner.tick(0)
    runner.answer("me", 1 * S)
    runner.tick(3 * S)
    runner.tick(4 * S - 1)
    assert sent == ["me"]
    runner.tick(4 * S)
    assert sent == ["me", None]


def test_a_pause_sends_nothing_until_it_is_over():
    runner, sent = runner_of(Pause(2.0), Ask("who"))
    assert runner.tick(0) is None
    assert runner.awaited is None
    assert runner.tick(2 * S - 1) is None
    assert runner.tick(2 * S) == Ask("who")
    assert sent == [None]


def test_an_answer_that_was_announced_may_take_its_time_out_again():
    runner, sent = runner_of(Ask("who"), Ask("where"))
    runner.tick(0)
    runner.wait_again(S - 1)
    assert runner.tick(S) is None
    runner.answer("me", 2 * S - 2)
    assert sent == ["me"]


def test_a_restart_closes_the_old_dialogue_and_begins_at_the_next_tick():
    closed = []

    def dialogue() -> Steps:
        try:
            yield Ask("who", 100.0)
        finally:
            closed.append(True)

    runner = DialogueRunner(dialogue)
    runner.tick(0)
    runner.restart()
    assert (closed, runner.awaited, runner.begun) == ([True], None, False)
    assert runner.tick(1) == Ask("who", 100.0)
