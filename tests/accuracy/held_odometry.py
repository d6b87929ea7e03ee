"""Recordings of another simulator, of which odometry says the same pose from some moment on."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

from mcap.reader import make_reader

from service.encoding import ODOMETRY
from tests.accuracy.given import off_and_nees, recording_of, wrong_row
from tests.accuracy.recorded import rewrite
from tests.accuracy.scored import against_truth, lost_percent, mapped
from tests.papers.report import Row, Section

RECORDINGS = ("corridor100d_s1", "ring_s3", "fgi_s1", "tshape_s2", "office300_s1")


class HeldOdometry:
    """Stamps go on; what stands behind the header stays as it was in the sample before."""

    HEADER_BYTES = 12  # of CDR, and the stamp

    def __init__(self, after: int) -> None:
        """after: so many samples are as they were."""
        self._left = after
        self._held = b""

    def __call__(self, type_name: str, payload: bytes) -> bytes | None:
        if type_name != ODOMETRY:
            return payload
        self._left -= 1
        if self._left >= 0 or not self._held:
            self._held = payload[self.HEADER_BYTES :]
            return payload
        return payload[: self.HEADER_BYTES] + self._held


def held_odometry(seeds: Sequence[int]) -> Section:  # recordings: seeds change nothing
    title = "Odometry that stands"
    if not recording_of(RECORDINGS[0]).exists():
        return Section(title, f"Left out: {recording_of(RECORDINGS[0])} is not there; set CORRIDOR_SHARED.")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in RECORDINGS:
            recording = recording_of(name)
            for what, share in (("from the begin", 0.0), ("from the half on", 0.5)):
                held, out = Path(folder) / "held.mcap", Path(folder) / f"{name}_{share}"
                rewrite(recording, held, HeldOdometry(int(share * _samples(recording))))
                rows += _rows(f"{name}, {what}", held, recording.with_suffix(".tum"), out)
    return Section(
        title,
        "Recordings of another simulator; the pose of odometry stays what it is, as of a dead encoder or a "
        "driver that repeats its last message; scans and IMU are as they were. ATE after the finish. One run "
        "each. The rule of [30] in estimator.md was made with all of them in view.",
        rows,
    )


def _samples(recording: Path) -> int:
    with recording.open("rb") as file:
        messages = make_reader(file).iter_messages()
        return sum(schema is not None and schema.name == ODOMETRY for schema, _, _ in messages)


def _rows(what: str, recording: Path, truth: Path, out: Path) -> list[Row]:
    done = mapped(recording, out)
    finished = against_truth(out / "trajectory.tum", truth)
    off_m, _ = off_and_nees(done, truth)
    return [
        Row(f"{what}: ATE", [1e3 * finished.ate_aligned_m.rms], "mm"),
        Row(f"{what}: scans lost", [lost_percent(done)], "%"),
        wrong_row(what, done, off_m),
    ]
