"""What a profile makes of recordings: of another simulator, with exact truth, and of real buildings."""

import json
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from service.offline.replay.replay import ReplayOptions, replay, write_replay
from service.offline.score.score import RelationsScore, score
from tests.papers.report import Row
from tests.shared_data import SHARED

# recording: its relations, and the shift of its stamps to theirs in s; `derived` ones are good to 5 to 10 cm
RELATIONS = {
    "fr079": ("official", 0.0),
    "intel": ("official", 0.0),
    "csail": ("derived_consecutive", 0.0),
    "aces": ("derived_consecutive", -1e9),
}


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
    """Replayed, whatever was scored before; settings as JSON."""
    folder = SHARED / ("datasets" if name in RELATIONS else "worlds") / name
    recording = folder / f"{name}.mcap"
    if not recording.is_file():
        return None
    with tempfile.TemporaryDirectory() as made:
        config = Path(made) / "mapping.yaml"  # JSON is YAML
        config.write_text(json.dumps({"mapping": {"profile": profile, "settings": json.loads(settings)}}))
        done = replay([recording], ReplayOptions(config=config))
        write_replay(done, Path(made))
        relations, shift_s = RELATIONS.get(name, ("", 0.0))
        truth = folder / (f"{relations}.relations" if relations else f"{name}.tum")
        found = score(Path(made) / "trajectory.tum", truth, shift_s=shift_s)
    lost = sum(output.state == "lost" for output in done.outputs) / len(done.outputs)
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
