"""Errors of a profile on recordings: of another simulator, with exact truth, and of real buildings."""

import json
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from service.offline.replay.replay import ReplayOptions, replay, write_replay
from service.offline.score.score import RelationsScore, score
from tests.accuracy.given import recording_of, truth_of
from tests.accuracy.recorded import percent_of
from tests.papers.report import Row

BUILDINGS = ("fr079", "intel", "csail", "aces")


@dataclass(frozen=True)
class Score:
    """error_m: of a world root mean square after the rigid motion that fits best; of a building the mean
    error of its relations.
    """

    error_m: float
    error_deg: float | None  # of a building
    closure_m: float | None  # of a world: the last pose against the first
    lost_share: float  # of the scans


def scored(profile: str, name: str, settings: dict[str, Any] | None = None) -> Score | None:
    """With these settings, every other at its default. None: the recording is not here."""
    return _scored(profile, name, json.dumps(settings or {}))


@cache
def _scored(profile: str, name: str, settings: str) -> Score | None:
    return rescored(profile, name, settings)


def rescored(profile: str, name: str, settings: str = "{}") -> Score | None:
    """Replayed again; settings as JSON."""
    recording = recording_of(name)
    if not recording.is_file():
        return None
    with tempfile.TemporaryDirectory() as made:
        laid_over = {"settings": json.loads(settings)}
        done = replay([recording], ReplayOptions(profile=profile, mapping=laid_over))
        write_replay(done, Path(made))
        truth, shift_s = truth_of(name)
        found = score(Path(made) / "trajectory.tum", truth, shift_s=shift_s)
    lost = percent_of(done, "lost") / 100.0
    if isinstance(found, RelationsScore):
        return Score(found.errors[0].translation_m.mean, found.errors[0].rotation_deg.mean, None, lost)
    return Score(found.ate_aligned_m.rms, None, found.closure_m, lost)


def error_row(
    ids: str,
    what: str,
    profile: str,
    name: str,
    at_most: float | None = None,
    settings: dict[str, Any] | None = None,
    cause: str = "",
) -> list[Row]:
    """One row, or none without the recording."""
    found = scored(profile, name, settings)
    return [] if found is None else [Row(f"{what}{name}", [found.error_m], "m", ids, at_most, cause=cause)]
