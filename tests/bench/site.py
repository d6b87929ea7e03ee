"""A site of 12 drives, two of another building: errors in one frame, and cost of one more. Real
drives in parts, and sites of more and more sessions.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from service.encoding import LASER_SCAN, ODOMETRY
from service.geometry.poses import compose
from service.offline.cluster.batch import run_batch
from service.offline.cluster.engines import Cluster, Engine, Processes, in_turn
from service.offline.cluster.session_task import new_tasks
from service.offline.replay.setup import ReplayOptions
from service.offline.score.score import align
from service.offline.score.trajectory import read_tum, write_tum
from service.offline.site.build import site_build
from service.offline.site.paths import PATHS
from service.recording.mcap_source import open_session
from tests.accuracy.recorded import against_relations, mapped, rewrite
from tests.bench import large_site
from tests.bench.cluster import digest_of
from tests.bench.site_drives import ELSEWHERE, SEEDS, record_drive
from tests.shared_data import SHARED

Row = tuple[str, float, str]
DATASETS, PARTS = SHARED / "datasets", {"fr079": 4, "intel": 3}
LAST = 20  # of the site; it is added to the others
SIZES = (20, 40, 60, 100)  # sessions of the large site


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
            assert digest_of(folder / "one") == digest_of(folder / other), f"other bytes by {other}"
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


def measure_parts() -> list[Row]:
    """Mean error of the official relations of real drives, mapped whole and as a site of their parts."""
    rows: list[Row] = []
    for name, count in PARTS.items():
        recording, relations = (DATASETS / name / file for file in (f"{name}.mcap", "official.relations"))
        if not recording.exists():
            continue
        with TemporaryDirectory(prefix="corridor-bench-") as temporary:
            folder = Path(temporary)
            (scans,) = open_session([recording]).scan_counts.values()
            ends = [round(k * scans / count) for k in range(count + 1)]
            parts = [folder / f"part_{k}.mcap" for k in range(count)]
            for part, (begin, end) in zip(parts, pairwise(ends), strict=True):
                rewrite(recording, part, _Part(begin, end))
            report = _build(parts, folder / "site", in_turn)
            assert not report["left_out"], report["left_out"]
            paths = [read_tum(folder / "site" / PATHS / f"{part.stem}.tum") for part in parts]
            write_tum(folder / "site.tum", (pose for path in paths for pose in path.poses()))
            mapped(recording, folder / "whole")
            for what, path in (("whole", "whole/trajectory.tum"), (f"{count} parts", "site.tum")):
                error = against_relations(folder / path, relations)
                rows.append((f"{name}, {what}: translation", 1e3 * error.translation_m.mean, "mm"))
                rows.append((f"{name}, {what}: rotation", error.rotation_deg.mean, "deg"))
    return rows


class _Part:
    """Scans `begin` to `end` - 1 of a recording, and the odometry between them."""

    def __init__(self, begin: int, end: int) -> None:
        self._begin, self._end = begin, end
        self._scans = 0

    def __call__(self, type_name: str, payload: bytes) -> bytes | None:
        is_there = self._begin <= self._scans < self._end or type_name not in (LASER_SCAN, ODOMETRY)
        self._scans += type_name == LASER_SCAN
        return payload if is_there else None


def measure_sizes() -> list[Row]:
    """Processor and memory of a site of 20 000 m2 that grows to 100 sessions of 500 m, and its ATE."""
    with TemporaryDirectory(prefix="corridor-bench-") as temporary:
        folder = Path(temporary)
        drives = [large_site.record_drive(seed, folder) for seed in range(1, SIZES[-1] + 1)]
        sessions = [session for session, *_ in drives]
        results = [folder / "r" / one.stem for one in sessions]
        began_s = time.process_time()
        run_batch(new_tasks([[one] for one in sessions], ReplayOptions(), results), in_turn, lambda *_: None)
        replay_s = (time.process_time() - began_s) / len(sessions)
        rows: list[Row] = [
            ("driven", sum(length_m for *_, length_m in drives) / 1e3, "km"),
            ("replay of a session, processor", replay_s, "s"),
        ]
        for begin, end in pairwise((0, *SIZES)):
            added = build_apart(results[begin:end], folder / "site")
            rows += [(f"{begin} sessions to {end}: {row[0]}", *row[1:]) for row in added]
        truths = {session.stem: truth for session, truth, _ in drives}
        return [*rows, ("ATE of all poses in one frame", 1e3 * _ate_m(folder / "site", truths), "mm")]


def build_apart(results: Sequence[Path], out: Path) -> list[Row]:
    """By a process of its own, whose memory is only that of the build."""
    command = [sys.executable, "-m", "service", "site", "build", *map(str, results)]
    command += ["--out", str(out), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
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
