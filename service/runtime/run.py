"""One run of the service in the foreground, from start to a signal, a deadline or a failure."""

import logging
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from service.config import ServiceConfig
from service.errors import CalledOffError
from service.runtime.early_mapper import EarlyMapper
from service.runtime.notify import Notifier
from service.runtime.service import Service
from service.runtime.signals import StopSignals
from service.runtime.summary import Summary

log = logging.getLogger(__name__)

TICK_S = 0.1


def run(
    config: ServiceConfig,
    seconds: float | None = None,
    map_folder: Path | None = None,
    on_ready: Callable[[Service], None] = lambda service: None,
    give_up: Callable[[], str] = lambda: "",
    watch: Callable[[Service], None] = lambda service: None,
    early: EarlyMapper | None = None,
) -> Summary:
    """Run the service until SIGTERM, SIGINT or SIGHUP, or for `seconds` from READY on. Main thread only.

    `give_up` is called several times a second and may return why to stop as a failure; `watch` is called as
    often, during the start too. `early` is a mapper's process that was begun for this config.

    Whatever ends the run, the recording is finished and the map saved first; the summary holds what failed
    after READY. Raises CorridorError where a part failed before, StorageError where Zenoh cannot listen,
    CalledOffError where a signal came before READY.
    """
    notifier = Notifier()
    with StopSignals() as signals:
        service = Service(config, notifier, map_folder, on_failure=signals.wake, early=early)
        reason = given_up = called_off = ""
        try:

            def is_cancelled() -> bool:
                watch(service)
                return bool(signals.received)

            if service.start(is_cancelled):
                on_ready(service)
                deadline_s = None if seconds is None else time.monotonic() + seconds
                while not service.failure and not (given_up := give_up()):
                    service.tick()
                    watch(service)
                    left_s = TICK_S if deadline_s is None else deadline_s - time.monotonic()
                    if left_s <= 0.0:
                        reason = f"{seconds:g} s are over"
                        break
                    if signals.wait(min(TICK_S, left_s)):
                        break
            else:
                called_off = signals.received
        finally:
            why = service.failure or given_up or reason or signals.received or "the start failed"
            log.info("stopping: %s", why)
            summary = service.stop()
            notifier.close()
    if called_off and not summary.failure:
        raise CalledOffError(signal.Signals[called_off])
    return replace(summary, failure="; ".join(filter(None, [given_up, summary.failure])))
