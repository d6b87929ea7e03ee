"""Map, states and data of a run with a fault, against the truth."""

import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from service.demo import interpolate
from service.encoding import Status, decode_diagnostics, decode_frame, decode_pose
from service.errors import CorridorError
from service.geometry.se2 import SE2
from service.mapstore.files import check_versions
from service.recording.mcap_reader import Recording
from tests.chaos.drive import Drive, Interval, Up, corridor

WRONG_M = 0.3
DEVICES = {"front/scan": 1 / 49.8, "rear/scan": 0.025, "lux/scan": 0.04, "imu/imu": 0.005, "base/odom": 0.015}
Times = npt.NDArray[np.int64]  # host monotonic, ns


@dataclass(frozen=True)
class Figures:
    """recovery_s   from the end of the cause until poses and frames of each device come again
    last           the last of them
    frames_lost    measurements of devices that are not in the recording, by the gaps between their stamps
    data_lost_s    the longest time within a run of the service without a message in the recording
    rmse_m, end_m  of the poses' positions, all, and those of the last second
    wrong_ok       poses more than WRONG_M off while the state in force was `ok`
    states         that were in force from the cause on
    damaged        files that cannot be read: recordings and maps
    """

    recovery_s: float
    last: str
    frames_lost: int
    data_lost_s: float
    rmse_m: float
    end_m: float
    wrong_ok: int
    states: tuple[str, ...]
    codes: tuple[int, ...] = ()
    damaged: tuple[str, ...] = ()


@dataclass(frozen=True)
class Expected:
    """Bounds of figures, and the exit codes."""

    recovery_s: float = 2.0
    data_lost_s: float = 1.1
    rmse_m: float = 0.1
    end_m: float = 0.15
    codes: tuple[int, ...] = (0,)

    def __str__(self) -> str:
        bounds = (
            (self.recovery_s, f"back within {self.recovery_s:g} s"),
            (self.data_lost_s, f"{self.data_lost_s:g} s of data lost"),
            (self.rmse_m, f"RMSE {self.rmse_m * 1e3:.0f} mm"),
        )
        words = [bound for value, bound in bounds if math.isfinite(value)]
        return ", ".join([*words, f"exit code {' or '.join(map(str, self.codes))}"])

    def missed_by(self, figures: Figures) -> list[str]:
        """Figures beyond their bounds, as text."""
        missed = [
            f"{name} {value:g}, at most {getattr(self, name):g} expected"
            for name in ("recovery_s", "data_lost_s", "rmse_m", "end_m")
            if not (value := getattr(figures, name)) <= getattr(self, name)
        ]
        if figures.wrong_ok:
            missed.append(f"{figures.wrong_ok} poses {WRONG_M} m off in the state ok")
        if not set(figures.codes) <= set(self.codes):
            missed.append(f"exit codes {figures.codes}")
        return [*missed, *figures.damaged]


@dataclass
class Evidence:
    """Content of a drive's recordings, on the host's monotonic clock."""

    stamps: dict[str, list[int]] = field(default_factory=lambda: {name: [] for name in DEVICES})
    arrivals: dict[str, list[int]] = field(default_factory=lambda: {name: [] for name in (*DEVICES, "pose")})
    logged: list[int] = field(default_factory=list)  # of any message
    poses: list[tuple[int, int, SE2]] = field(default_factory=list)  # map that it is in, stamp, pose_map_base
    states: list[tuple[int, str]] = field(default_factory=list)  # since when

    def add(self, recording: Recording, number: int) -> None:
        """Raises InputError. number: of the map that it is in, from 0."""
        offset_ns = int(recording.metadata["clock"]["utc_offset_ns"])
        for message in recording.messages():
            at_ns = message.log_ns - offset_ns
            self.logged.append(at_ns)
            if message.channel in self.arrivals:
                self.arrivals[message.channel].append(at_ns)
            if message.channel == "pose":
                pose = decode_pose(message.payload)
                self.poses.append((number, pose.stamp_ns - offset_ns, pose.pose))
            elif message.channel in self.stamps:
                frame = decode_frame(message.type, message.payload, "", message.log_ns)
                self.stamps[message.channel].append(frame.stamp_ns - offset_ns)
            elif message.channel == "diagnostics":
                self.states.append((at_ns, _state(decode_diagnostics(message.payload))))


def _state(statuses: Sequence[Status]) -> str:
    return next(one.values.get("state", "waiting") for one in statuses if one.name == "mapping")


def errors_m(evidence: Evidence, truth: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(N,) position error of each pose, m; 0 for the first of each map, by definition."""
    true = interpolate(truth, np.array([stamp_ns for _, stamp_ns, _ in evidence.poses]))
    origin: dict[int, SE2] = {}
    found = []
    for (number, _, pose), really in zip(evidence.poses, true, strict=True):
        world_map = origin.setdefault(number, really @ pose.inverse())
        away = really.inverse() @ world_map @ pose
        found.append(math.hypot(away.x_m, away.y_m))
    return np.array(found)


def judge(evidence: Evidence, truth: npt.NDArray[np.float64], cause: Interval, ups: Sequence[Up]) -> Figures:
    off_m = errors_m(evidence, truth)
    stamps_ns = np.array([stamp_ns for _, stamp_ns, _ in evidence.poses])
    since_ns = np.array([at_ns for at_ns, _ in evidence.states])
    states = np.array(["waiting", *(state for _, state in evidence.states)])
    in_force = states[np.searchsorted(since_ns, stamps_ns, "right")]
    later = [state for at_ns, state in evidence.states if at_ns >= cause.from_ns]
    back_ns = {name: _first_after(times, cause.until_ns) for name, times in evidence.arrivals.items()}
    last = max(back_ns, key=lambda name: back_ns[name])
    return Figures(
        recovery_s=round((back_ns[last] - cause.until_ns) / 1e9, 2),
        last=last,
        frames_lost=sum(_missing(evidence.stamps[name], period_s) for name, period_s in DEVICES.items()),
        data_lost_s=round(max(longest_gap_ns(evidence.logged, up) for up in ups) / 1e9, 2),
        rmse_m=round(float(np.sqrt(np.mean(off_m**2))), 3),
        end_m=round(float(off_m[stamps_ns > stamps_ns[-1] - 10**9].max()), 3),
        wrong_ok=int(np.sum((in_force == "ok") & (off_m > WRONG_M))),
        states=tuple(dict.fromkeys(later)),
        codes=tuple(up.code for up in ups),
    )


def _first_after(times_ns: Sequence[int], from_ns: int) -> float:
    """The first of these times from then on; infinity where there is none."""
    return min((at_ns for at_ns in times_ns if at_ns >= from_ns), default=math.inf)


def _missing(stamps_ns: Sequence[int], period_s: float) -> int:
    """Measurements missing between these."""
    periods = np.diff(np.array(sorted(stamps_ns))) / (period_s * 1e9)
    return int(np.sum(np.round(periods[periods > 1.5]) - 1))


def longest_gap_ns(logged_ns: Sequence[int], up: Up) -> int:
    """Between two messages that follow each other while the service was up, its end included."""
    within = [at_ns for at_ns in logged_ns if up.from_ns <= at_ns <= up.until_ns]
    times_ns = np.array([*sorted(within), up.until_ns])
    return int(np.diff(times_ns).max()) if within else up.until_ns - up.from_ns


def judged(drive: Drive) -> Figures:
    """Of the files of the drive; recordings that were not ended are recovered first, in a copy."""
    damaged, evidence, copy = [], Evidence(), drive.folder / "copy"
    shutil.copytree(drive.service.sessions, copy, ignore=lambda *_: {"lost+found"})
    for unfinished in copy.glob("*.mcap.active"):
        done = corridor("recover", unfinished)
        if done.returncode != 0:
            damaged.append(f"{unfinished.name}: {done.stderr}")
    for path in sorted(copy.glob("*.mcap")):
        try:
            recording = Recording([path])
            ended_ns = recording.last_log_ns - int(recording.metadata["clock"]["utc_offset_ns"])
            runs = [up for up in drive.ups if up.from_ns <= ended_ns]
            evidence.add(recording, sum(not up.is_resumed for up in runs))
        except CorridorError as error:
            damaged.append(f"{path.name}: {error}")
    for folder in sorted(path.parent for path in drive.service.maps.glob("*/map.yaml")):
        damaged += check_versions(folder)[1]
    assert evidence.poses, f"no pose was recorded; {damaged}"
    figures = judge(evidence, np.loadtxt(drive.folder / "truth.txt"), drive.cause, drive.ups)
    return replace(figures, damaged=tuple(damaged))


def worst(runs: Sequence[Figures]) -> Figures:
    """Of each figure."""
    names = ("recovery_s", "frames_lost", "data_lost_s", "rmse_m", "end_m")
    return Figures(
        **{name: max(getattr(run, name) for run in runs) for name in names},
        last=max(runs, key=lambda run: run.recovery_s).last,
        wrong_ok=sum(run.wrong_ok for run in runs),
        states=tuple(dict.fromkeys(state for run in runs for state in run.states)),
        codes=tuple(code for run in runs for code in run.codes),
        damaged=tuple(words for run in runs for words in run.damaged),
    )
