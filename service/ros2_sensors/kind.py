"""What the three types have in common: wire and session of a topic."""

from collections.abc import Callable
from functools import partial

from drivers.link import Session
from drivers.sensor_kind import SensorKind
from drivers.transport import Transport
from service.ros2_sensors.config import Ros2SensorConfig
from service.ros2_sensors.session import Ros2Session


def kind_of(config: type[Ros2SensorConfig], message_type: str, what: str, laser: bool = False) -> SensorKind:
    """what: its messages in counters, plural."""

    def open_port(config: Ros2SensorConfig) -> Transport:
        from service.ros2_sensors.port import Subscription  # brings Zenoh, which no reader of a config needs

        return Subscription(config, message_type)

    def session_maker(config: Ros2SensorConfig) -> Callable[[], Session]:
        return partial(Ros2Session, config, message_type, what)

    return SensorKind(config, open_port, session_maker, laser=laser)
