"""A site of 12 drives, two of another building: do they lie in one frame, and what does one more cost."""

import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from service.offline.cluster.batch import run_batch
from service.offline.cluster.engines import Cluster, Engine, Processes, in_turn
from service.offline.cluster.tasks import new_tasks
from service.offline.replay.setup import ReplayOptions
from service.offline.score.score import align, compose
from service.offline.score.trajectory import read_tum
from service.offline.site.build import site_build
from service.offline.site.paths import PATHS
from tests.bench.cluster import digest
from tests.bench.site_drives import ELSEWHERE, SEEDS, record_drive

Row = tuple[str, float, str]
LAST = 20  # of the site; it is added to the others


def measure() -> list[Row]:
    with TemporaryDirectory(prefix="corridor-bench-") as temporary:
        folder = Path(temporary)
        truths = dict(record_drive(seed, folder) for seed in SEEDS)
        sessions = list(truths)
        tasks = new_tasks(
            [[one] for one in sessions], ReplayOptions(), [folder / "r" / one.stem for one in sessions]
        )
        began_s = time.process_time()
        run_batch(tasks, in_turn, lambda *_: None)
        replay_s = (time.process_time() - began_s) / len(sessions)
        results = [task.folder for task in tasks]
        report = _build(results, folder / "one", in_turn)
        with Processes(2) as processes:
            _build(results, folder / "two", processes)
        with Cluster("local:2") as cluster:
            _build(results, folder / "cluster", cluster)
        for other in ("two", "cluster"):
            assert digest(folder / "one") == digest(folder / other), f"other bytes by {other}"
        left_out = [f"site_{seed}" for seed in ELSEWHERE]
        assert list(report["left_out"]) == left_out, report["left_out"]
        last = folder / "r" / f"site_{LAST}"
        others = [one for one in results if one != last and one.name not in left_out]
        _build(others, folder / "grown", in_turn)
        began_s = time.process_time()
        _build([last], folder / "grown", in_turn)
        added_s = time.process_time() - began_s
        ate_m = _ate_m(folder / "one", {session.stem: truth for session, truth in truths.items()})
    return [
        ("ATE of all poses in one frame", 1e3 * ate_m, "mm"),
        ("replay of a session, processor", replay_s, "s"),
        ("one more, besides its replay, processor", added_s, "s"),
        ("one more, with its replay, of a replay", 1.0 + added_s / replay_s, "x"),
    ]


def _build(sessions: Sequence[Path], out: Path, engine: Engine) -> dict[str, Any]:
    return site_build(sessions, ReplayOptions(), out, engine, lambda *_: None)


def _ate_m(site: Path, truths: dict[str, Path]) -> float:
    """RMS distance after the best rigid motion of all paths together."""
    estimates, true = [], []
    for path in sorted((site / PATHS).iterdir()):
        estimate = read_tum(path)
        estimates.append(estimate.pose)
        true.append(read_tum(truths[path.stem]).at(estimate.stamp_ns))
    poses, expected = np.vstack(estimates), np.vstack(true)
    off = compose(align(poses, expected), poses) - expected
    return float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()))
