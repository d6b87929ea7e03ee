"""What the sessions of all robots share: start, text, banner, and silence in words. No I/O."""

import logging
from collections import Counter

from drivers.irobot_create.config import GIVE_UP_NS, IrobotCreateConfig
from drivers.irobot_create.health import RobotHealth
from drivers.irobot_create.odometry import DeadReckoning, TwistWindow
from drivers.irobot_create.protocol import BANNER_END_NS, banner_identity, is_banner

log = logging.getLogger(__name__)


class RobotSession:
    """Base of both sessions. The pose never jumps: what is unknown or implausible is left out of it, and
    added to its covariance instead.
    """

    _button = "Clean"  # which wakes the robot

    def __init__(
        self, config: IrobotCreateConfig, odometry: DeadReckoning | None, twist: TwistWindow
    ) -> None:
        self._config = config
        self.outbox = bytearray()
        self.counters: Counter[str] = Counter()
        self.status = "waking the robot"
        self.identity: dict[str, str] = {"model": config.model}
        self._health = RobotHealth(self.counters)
        self._odometry = odometry or DeadReckoning(config.wheel_base_m, config.travel_variance_m2_per_m)
        self._twist = twist
        self._byte_ns = 10e9 / config.baud
        self._bytes_heard = 0
        self._start_at_ns: int | None = None
        self._last_heard_ns: int | None = None  # frame, answer or banner; None before the first tick
        self._in_banner_until_ns = 0

    def _take_line(self, line: str, arrived_ns: int, was_running: bool) -> bool:
        """Text of the robot; True where it was reset."""
        self.counters["text_lines"] += 1
        log.debug("%s says: %s", self._config.name, line)
        if not is_banner(line):
            return False
        self.identity |= banner_identity(line)
        if arrived_ns > self._in_banner_until_ns and was_running:
            self.counters["robot_resets"] += 1
        self._in_banner_until_ns = self._start_at_ns = arrived_ns + BANNER_END_NS
        self._last_heard_ns = arrived_ns
        self.status = "the robot was reset; waiting for the end of its banner"
        return True

    def _explain_silence(self, stopped: str, missing: str) -> str:
        """stopped: what it sent until now, in words, "" for nothing; missing: what it should send."""
        seconds, baud = f"{GIVE_UP_NS / 1e9:.0f} s", self._config.baud
        wake = f"press its {self._button} button, or wire BRC to RTS or DTR"
        if stopped:
            return f"{stopped}; fell asleep, was switched off or unplugged? {wake}"
        if self._bytes_heard:
            return (
                f"{self._bytes_heard} bytes but no {missing} in {seconds}; is {baud} the robot's baud rate, "
                f"is it a {self._config.model}, is another program reading this port?"
            )
        return (
            f"no answer to Start (128) in {seconds}; is the robot asleep or off? {wake}; else look at cable "
            f"and baud rate ({baud})"
        )
