"""Given recordings of two such scenes, with as much of the truth as is known."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.frames import Frame, OdometrySample
from service.geometry.se2 import SE2
from service.offline.replay.replay import ReplayOptions, replay
from service.outputs import MapperOutput
from service.recording.mcap_source import open_session
from tests.accuracy.scene_judge import Verdict, judge
from tests.shared_data import SHARED

Truth = Callable[[list[Frame]], Callable[[int], SE2]]  # of its frames, the base at a stamp


@dataclass(frozen=True)
class Given:
    """A recording in the folder `cases`. The vehicle drives straight on."""

    from_s: float  # since the first scan
    to_s: float
    truth: Truth


def _by_odometry(end_m: float) -> Truth:
    """Good wheels, scaled to where the drive ends, on the line on which it began."""

    def of(frames: list[Frame]) -> Callable[[int], SE2]:
        samples = [frame for frame in frames if isinstance(frame, OdometrySample)]
        stamp_ns, path_length_m = np.array([(sample.stamp_ns, sample.x_m) for sample in samples]).T
        return lambda at_ns: SE2(
            float(np.interp(at_ns, stamp_ns, path_length_m) * end_m / path_length_m[-1]), 0.0, 0.0
        )

    return of


def _at_constant_speed(speed_mps: float) -> Truth:
    return lambda frames: lambda at_ns: SE2(speed_mps * 1e-9 * (at_ns - frames[0].stamp_ns), 0.0, 0.0)


RECORDINGS = {
    "escort5_s41_0_16s": Given(1.9, 16.0, _by_odometry(13.25)),
    "ramp_laser_s41_12_22s": Given(4.9, 9.0, _at_constant_speed(1.0)),
}


@dataclass(frozen=True)
class Replayed:
    """What a mapper made of one."""

    outputs: list[MapperOutput]
    truth: list[SE2]  # seen from the first scan
    from_ns: int
    to_ns: int

    @property
    def verdict(self) -> Verdict:
        return judge(self.outputs, self.truth, self.from_ns, self.to_ns)


def recording_of(name: str) -> Path:
    return SHARED / "cases" / f"{name}.mcap"


def replayed(name: str, profile: str | None = None) -> Replayed:
    """Raises FileNotFoundError where the recordings are not there."""
    path = recording_of(name)
    if not path.exists():
        raise FileNotFoundError(f"{path} is not there; set CORRIDOR_SHARED")
    given = RECORDINGS[name]
    outputs = replay([path], ReplayOptions(profile=profile)).outputs
    at = given.truth(list(open_session([path]).frames()))
    first_ns = outputs[0].stamp_ns
    first = at(first_ns).inverse()
    return Replayed(
        list(outputs),
        [first @ at(output.stamp_ns) for output in outputs],
        first_ns + round(given.from_s * 1e9),
        first_ns + round(given.to_s * 1e9),
    )
