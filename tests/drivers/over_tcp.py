"""A driver's link and a fake device on a loopback port, in real time."""

import threading
from collections.abc import Callable
from typing import Any

from drivers.frames import Frame
from drivers.link import LinkHealth, run_link
from drivers.registry import SENSOR_KINDS
from simulators.device import FakeDevice
from simulators.wire import TcpWire, serve_tcp

PATIENCE_S = 60.0


def frames_over_tcp(
    type_name: str,
    device: FakeDevice,
    config: Callable[..., Any],
    enough: int,
    at_frame: Callable[[int, TcpWire], None] = lambda count, wire: None,
) -> tuple[list[Frame], LinkHealth]:
    """What run_link gives until so many frames were read, and its health then.

    config      made with host and port
    at_frame    called after each frame, with their number and the wire
    """
    wire = serve_tcp(device)
    with wire as (host, port):
        chosen = config(host=host, port=port)
        return frames_of_driver(type_name, chosen, enough, lambda count: at_frame(count, wire))


def frames_of_driver(
    type_name: str, config: Any, enough: int, at_frame: Callable[[int], None] = lambda count: None
) -> tuple[list[Frame], LinkHealth]:
    """The same from whatever listens where the config says."""
    kind, health, stop = SENSOR_KINDS[type_name], LinkHealth(type_name), threading.Event()
    frames: list[Frame] = []

    def sink(frame: Frame) -> None:
        frames.append(frame)
        at_frame(len(frames))
        if len(frames) >= enough:
            stop.set()

    guard = threading.Timer(PATIENCE_S, stop.set)
    guard.start()
    try:
        run_link(health, lambda: kind.open_transport(config), kind.session_maker(config), sink, stop)
    finally:
        guard.cancel()
        guard.join()
    return frames, health
