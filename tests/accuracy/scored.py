"""Replays of recordings by the default profile, and how far their trajectories are off."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.offline.replay.replay import Replay, ReplayOptions, replay, write_replay
from service.offline.score.score import RelationErrors, RelationsScore, TrajectoryScore, score


def mapped(recording: Path, out: Path, settings: Mapping[str, Any] | None = None) -> Replay:
    """Its result is in `out`. settings: other values of some keys, by box."""
    done = replay([recording], ReplayOptions(mapping={"settings": settings} if settings else {}))
    write_replay(done, out)
    return done


def lost_percent(done: Replay) -> float:
    """Of the scans."""
    return 100.0 * sum(output.state == "lost" for output in done.outputs) / len(done.outputs)


def against_truth(estimate: Path, truth: Path) -> TrajectoryScore:
    found = score(estimate, truth)
    assert isinstance(found, TrajectoryScore)
    return found


def against_relations(
    estimate: Path, relations: Path, shift_s: float = 0.0, offset_x_m: float = 0.0
) -> RelationErrors:
    """In Kuemmerle's order, expected^-1 * relative."""
    found = score(estimate, relations, shift_s, offset_x_m)
    assert isinstance(found, RelationsScore)
    return found.errors[0]
