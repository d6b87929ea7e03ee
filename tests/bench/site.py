"""A site of 12 drives, two of another building: do they lie in one frame, and what does one more cost."""

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from service.geometry.poses import compose
from service.offline.cluster.batch import run_batch
from service.offline.cluster.engines import Cluster, Engine, Processes, in_turn
from service.offline.cluster.session_task import new_tasks
from service.offline.replay.setup import ReplayOptions
from service.offline.score.score import align
from service.offline.score.trajectory import read_tum
from service.offline.site.build import site_build
from service.offline.site.paths import PATHS
from tests.bench.site_drives import ELSEWHERE, SEEDS, record_drive

Row = tuple[str, float, str]
LAST = 20  # of the site; it is added to the others
SIZES, SHORT_S = (20, 40, 60, 100), 40.0  # sessions of a site, of so many s each


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
            assert _digest(folder / "one") == _digest(folder / other), f"other bytes by {other}"
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


def measure_sizes() -> list[Row]:
    """Processor and memory for sites of more and more sessions of one place: 350 m of corridors and rooms."""
    with TemporaryDirectory(prefix="corridor-bench-") as temporary:
        folder = Path(temporary)
        first = SEEDS[-1] + 1
        seeds = range(first, first + max(SIZES))
        sessions = [record_drive(seed, folder, SHORT_S)[0] for seed in seeds]
        results = [folder / "r" / one.stem for one in sessions]
        began_s = time.process_time()
        run_batch(new_tasks([[one] for one in sessions], ReplayOptions(), results), in_turn, lambda *_: None)
        replay_s = (time.process_time() - began_s) / len(sessions)
        rows: list[Row] = [("replay of a short session, processor", replay_s, "s")]
        for count in SIZES:
            out = folder / str(count)
            *at_once, last = results[:count]
            rows += [(f"{count - 1} sessions: {row[0]}", *row[1:]) for row in build_apart(at_once, out)]
            rows += [(f"one more, of {count}: {row[0]}", *row[1:]) for row in build_apart([last], out)]
    return rows


def build_apart(results: Sequence[Path], out: Path) -> list[Row]:
    """By a process of its own, whose memory is only that of the build."""
    command = [
        sys.executable,
        "-m",
        "service",
        "site",
        "build",
        *map(str, results),
        "--out",
        str(out),
        "--json",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        report = json.loads(process.stdout.read())
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert not process.returncode, report
    used_s = used.ru_utime + used.ru_stime
    return [
        ("in the map", float(len(report["sessions"])), ""),
        ("processor", used_s, "s"),
        ("processor a session", used_s / len(results), "s"),
        ("memory", used.ru_maxrss / 1e3, "MB"),
    ]


def _build(sessions: Sequence[Path], out: Path, engine: Engine) -> dict[str, Any]:
    return site_build(sessions, ReplayOptions(), out, engine, lambda *_: None)


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(f"{path.relative_to(folder)}".encode() + path.read_bytes())
    return digest.hexdigest()


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
