"""Every fake device after its process got no processor for a time."""

from typing import Any

import numpy as np
import pytest

from drivers.frames import GnssFix
from simulators.device import TURNS_SKIPPED
from tests.drivers.faulty_devices import BENCHES
from tests.drivers.virtual_time import SECOND_NS, Talk
from tests.soaked import in_soak

SHORT = ("lms100 cola_a", "utm30lx usb", "lux", "mtig mtdata2", "create2")  # one of each kind
BY_TURNS = [  # without create1, which sends only on request
    name if name in SHORT else in_soak(name) for name in BENCHES if name != "create1"
]


def _streaming(name: str) -> Talk:
    bench = BENCHES[name]
    talk = Talk(None, bench.device())  # type: ignore[arg-type]
    talk.session = bench.sessions(lambda: talk.now_ns)()
    return talk.connect().run(4.0)


def _missed(talk: Talk) -> int:
    """By the driver's counters of lost measurements."""
    counters = talk.session.counters
    return sum(counters[name] for name in ("scans_missed", "samples_missed", "frames_missed"))


@pytest.mark.parametrize("name", BY_TURNS)
def test_a_starved_device_sends_every_turn_late_and_after_more_than_a_second_skips_turns(name: str):
    """Those sent have their right time; the driver counts as many lost as are skipped."""
    talk = _streaming(name)
    device: Any = talk.device
    for _ in range(2):
        talk.now_ns += round(0.9 * SECOND_NS)
        talk.run(1.1)
    assert device.counters[TURNS_SKIPPED] == 0
    assert _missed(talk) == 0
    stamps_s = np.array([f.stamp_ns for f in talk.frames if not isinstance(f, GnssFix)]) / 1e9
    rate_hz = BENCHES[name].rate_hz
    period_s = 1.0 / rate_hz
    assert np.diff(stamps_s) == pytest.approx(period_s, abs=0.2 * period_s)
    assert talk.now_ns / 1e9 - stamps_s[-1] < 2 * period_s + 0.05

    talk.now_ns += 2 * SECOND_NS
    talk.run(2.0)
    assert device.counters[TURNS_SKIPPED] == pytest.approx(2 * rate_hz, abs=0.05 * rate_hz + 1)
    if (
        name != "create2"
    ):  # its frames have neither number nor time: lost and late ones cannot be distinguished
        assert _missed(talk) == device.counters[TURNS_SKIPPED]
