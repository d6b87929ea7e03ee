"""Share of a core that the drivers take while all five kinds of device stream to them."""

import tempfile
import threading
import time
from pathlib import Path

from drivers.link import LinkHealth, run_link
from drivers.registry import SENSOR_KINDS
from service.demo import DemoOptions, demo_config, simulators

SECONDS = 20.0
STREAMING_TIMEOUT_S = 20.0
STOP_TIMEOUT_S = 5.0
LOOK_S = 0.1


def measure() -> list[tuple[str, float, str]]:
    """Only the reader threads, by their own clocks; mapper, recorder and publisher do not run."""
    stop = threading.Event()
    with tempfile.TemporaryDirectory() as folder:
        options = DemoOptions(None, None, None, 1, Path(folder))
        with simulators(options, Path(folder) / "truth.txt") as fakes:
            sensors = demo_config(fakes.endpoints, options, 0).sensors
            links = {name: LinkHealth(name) for name in sensors}
            readers = {name: _reader(links[name], sensor, stop) for name, sensor in sensors.items()}
            try:
                _wait_until_streaming(links, stop)
                before_s, began_s = _cpu_s(readers), time.monotonic()
                stop.wait(SECONDS)
                after_s, took_s = _cpu_s(readers), time.monotonic() - began_s
            finally:
                stop.set()
                for reader in readers.values():
                    reader.join(STOP_TIMEOUT_S)
    shares = {name: 100.0 * (after_s[name] - before_s[name]) / took_s for name in sensors}
    rows = [(f"{sensors[name].type}: CPU of its driver", share, "%") for name, share in shares.items()]
    return [*rows, ("all five: CPU of the drivers", sum(shares.values()), "%")]


def _reader(link: LinkHealth, sensor, stop: threading.Event) -> threading.Thread:  # type: ignore[no-untyped-def]
    kind = SENSOR_KINDS[sensor.type]
    arguments = (link, lambda: kind.open_transport(sensor), kind.session_maker(sensor), lambda frame: None)
    thread = threading.Thread(target=run_link, args=(*arguments, stop), name=f"reader-{link.name}")
    thread.start()
    return thread


def _wait_until_streaming(links: dict[str, LinkHealth], stop: threading.Event) -> None:
    deadline_s = time.monotonic() + STREAMING_TIMEOUT_S
    while silent := [f"{link.name}: {link.status}" for link in links.values() if link.state != "streaming"]:
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"after {STREAMING_TIMEOUT_S:.0f} s these do not stream: {', '.join(silent)}")
        stop.wait(LOOK_S)


def _cpu_s(readers: dict[str, threading.Thread]) -> dict[str, float]:
    clocks = {name: time.pthread_getcpuclockid(thread.ident or 0) for name, thread in readers.items()}
    return {name: time.clock_gettime(clock) for name, clock in clocks.items()}
