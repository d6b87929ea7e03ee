"""The row in health of a sink that sends messages by channel."""

from collections import Counter
from collections.abc import Mapping

from service.encoding import OK, WARNING, Status
from service.outputs import reason_value


def counted_row(name: str, counters: Mapping[str, Counter[str]], more: Mapping[str, str]) -> Status:
    """A warning where "dropped" or "failed" of the counters is not empty.

    more   values beside `<counter>.<channel>`; empty ones are left out
    """
    values = {
        f"{what}.{channel}": str(count)
        for what, counter in counters.items()
        for channel, count in sorted(counter.items())
    }
    values |= {key: text for key, text in more.items() if text}
    dropped, failed = counters["dropped"].total(), counters["failed"].total()
    if dropped or failed:
        words = f"{dropped} dropped, {failed} failed (expected none); is the network too slow?"
        return Status(name, WARNING, words, values | reason_value("messages_dropped"))
    return Status(name, OK, "ok", values)
