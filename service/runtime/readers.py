"""Threads whose failure ends the service; and those that read the devices, one a sensor."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from drivers.frames import Frame
from drivers.link import LinkHealth, RawChunk, run_link
from service.deadline import Deadline
from service.encoding import Message, encode_raw
from service.sensor_kinds import SENSOR_KINDS

STOP_S = 3.0  # for all; a connect to a silent host takes 3 s
log = logging.getLogger(__name__)


class Workers:
    """Named threads; the first exception that leaves one of them is kept and `on_failure` is called.

    A service without one of its threads lives and maps nothing, so its owner watches `failure`
    and stops the others in good order.
    """

    def __init__(self, on_failure: Callable[[], None]) -> None:
        self._on_failure = on_failure
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self.failure: str = ""  # which thread failed, and how; "" while none has

    def start(self, name: str, work: Callable[[], None]) -> threading.Thread:
        thread = threading.Thread(target=self._guard, args=(name, work), name=name, daemon=True)
        self._threads.append(thread)
        thread.start()
        return thread

    def join(self, thread: threading.Thread, timeout_s: float) -> bool:
        """Wait for one thread to end; False, and a warning, if it does not within timeout_s."""
        thread.join(timeout_s)
        if thread.is_alive():
            log.error("thread %s did not end within %.1f s; leaving it behind", thread.name, timeout_s)
            return False
        return True

    def fail(self, name: str, error: BaseException) -> None:
        """Note that `name` cannot go on. Only the first failure counts; the others follow from it."""
        with self._lock:
            if not self.failure:
                self.failure = f"{name}: {type(error).__name__}: {error}"
        self._on_failure()

    def _guard(self, name: str, work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:  # also SystemExit: nothing may end a thread unseen
            log.exception("thread %s failed", name)
            self.fail(name, error)


class Readers:
    """`start`, at last `stop`; `links` gives the state of each sensor.

    sensors         name -> the config model of its type
    put_frame       takes each frame, in the thread of its reader
    put_raw         takes the bytes of the devices as messages; None: no one wants them
    utc_offset_ns   Unix time minus host monotonic clock
    """

    def __init__(
        self,
        sensors: Mapping[str, Any],
        links: Mapping[str, LinkHealth],
        workers: Workers,
        put_frame: Callable[[Frame], None],
        put_raw: Callable[[Message], None] | None,
        utc_offset_ns: int,
    ) -> None:
        self._sensors = sensors
        self._links = links
        self._workers = workers
        self._put_frame = put_frame
        self._put_raw = put_raw
        self._utc_offset_ns = utc_offset_ns
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        for name, sensor in self._sensors.items():
            self._threads.append(self._workers.start(f"reader-{name}", self._reader(name, sensor)))

    def stop(self, deadline: Deadline) -> None:
        """Disconnect every device, in order of the config; one that hangs is left behind."""
        self._stop.set()
        until_s = time.monotonic() + STOP_S
        for thread in self._threads:
            if not self._workers.join(thread, max(until_s - time.monotonic(), 0.0)):
                deadline.found_hung()

    def _reader(self, name: str, sensor: Any) -> Callable[[], None]:
        kind = SENSOR_KINDS[sensor.type]
        new_session = kind.session_maker(sensor)
        tee = None if self._put_raw is None else partial(self._tee, name, self._put_raw)

        def read() -> None:
            run_link(
                self._links[name],
                lambda: kind.open_transport(sensor),
                new_session,
                self._put_frame,
                self._stop,
                tee,
            )

        return read

    def _tee(self, name: str, put_raw: Callable[[Message], None], chunk: RawChunk) -> None:
        put_raw(encode_raw(name, chunk, self._utc_offset_ns))
