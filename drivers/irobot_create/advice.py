"""Hints on the robot for `corridor doctor`: its baud rates and the form of its stream.

At other baud rates the doctor only listens: bytes sent at a wrong rate are other bytes to the robot, some
of which are commands that make it drive.
"""

from drivers.advice import Advice
from drivers.irobot_create.config import IrobotCreateConfig
from drivers.irobot_create.driver import STREAM_IDS
from drivers.irobot_create.protocol import FRAME_PERIOD_NS, StreamDecoder, is_banner

CERTAIN_FRAMES = 2


def rate_hz(config: IrobotCreateConfig) -> float:
    if config.model == "create1":
        return 1000.0 / config.poll_interval_ms
    return 1e9 / FRAME_PERIOD_NS


def recognise(data: bytes) -> str:
    """A Create 2's stream as this driver requests it, or the text of a robot that was reset."""
    decoder = StreamDecoder(STREAM_IDS)
    frames = decoder.receive_data(data)
    if len(frames) >= CERTAIN_FRAMES or any(is_banner(line) for line in decoder.lines):
        return "an iRobot Create or Roomba"
    return ""


ADVICE = Advice(
    name="base",
    at_port={},
    rate_hz=rate_hz,
    recognise=recognise,
    bauds=(115_200, 57_600, 38_400, 28_800, 19_200),
    worries=("low battery", "wheel dropped", "charging fault", "jump"),
    start_up_s=9.0,
    silence="press the robot's Clean button: asleep it answers nothing; is it off, is the level shifter "
    "powered, is baud what the robot was set to?",
)
