"""Sessions as tasks: the same bytes on every engine, nothing done twice, a death costs its own task."""

import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import dask
import pytest
from pyarrow import parquet

from service.cli import main
from service.errors import CorridorError, InputError, UsageError
from service.offline.cluster.batch import TABLE_FILE, run_batch
from service.offline.cluster.engines import MAX_TRIES, Cluster, Engine, Processes, in_turn
from service.offline.cluster.session_task import Task, new_tasks
from service.offline.cluster.tasks import Done
from service.offline.past.result import DONE_FILE
from service.offline.replay.replay import ReplayOptions, replay_to
from tests.service.offline.cluster.deadly_task import DeadlyTask
from tests.service.offline.recorded_drives import RecordDrive
from tests.soaked import in_soak


def run_all(tasks: list[Task], engine: Engine = in_turn) -> list[Done]:
    return run_batch(tasks, engine, lambda *_: None)


def results_in(folder: Path) -> dict[str, bytes]:
    """All files but those that have times of the computer."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    own = {path for path in files if path.name in ("summary.json", TABLE_FILE)}
    return {str(path.relative_to(folder)): path.read_bytes() for path in files if path not in own}


Judge = Callable[..., None]


@pytest.fixture
def judge(tmp_path: Path) -> Judge:
    """Has an engine do a task whose process dies once and, where asked, one whose process always dies."""

    def run(engine: Engine, log_line: str | None) -> None:
        once, always = DeadlyTask(tmp_path / "once", 1), DeadlyTask(tmp_path / "always", 99)
        done, *lost = run_batch([once, always] if log_line is not None else [once], engine, lambda *_: None)
        assert done.outcome == {"deaths": 1}
        for one in lost:
            assert "died, each of 3 times" in str(one.outcome)
            assert str(log_line) in str(one.outcome)
            # fewer by itself where it was cut off with the other before it came so far
            assert 1 < always.deaths <= MAX_TRIES

    return run


def test_a_process_that_dies_costs_its_own_task_alone(judge: Judge):
    with Processes(2) as processes:
        judge(processes, "The last of its log")


ORPHANING = """
import sys
from pathlib import Path
from service.offline.cluster.engines import Processes
from tests.service.offline.cluster.deadly_task import OrphanedTask
if __name__ == "__main__":
    with Processes(1) as processes:
        list(processes([OrphanedTask(Path(sys.argv[1]))]))
"""


def test_processes_end_with_a_command_that_is_killed(tmp_path: Path):
    place = tmp_path / "process"
    command = subprocess.run([sys.executable, "-c", ORPHANING, str(place)], check=False, timeout=120.0)
    assert command.returncode == -signal.SIGKILL
    process = int(place.read_text())
    try:
        ended = os.pidfd_open(process)
    except ProcessLookupError:
        return
    has_ended = bool(select.select([ended], [], [], 10.0)[0])
    if not has_ended:
        signal.pidfd_send_signal(ended, signal.SIGKILL)
    os.close(ended)
    assert has_ended


@pytest.mark.parametrize("log_line", [None, in_soak("begins on tcp://127.0.0.1:")])
def test_dask_tries_the_task_of_a_dead_worker_again(
    log_line: str | None, judge: Judge, caplog: pytest.LogCaptureFixture
):
    caplog.set_level("INFO")
    with Cluster("local:1" if log_line is None else "local:2") as cluster:
        judge(cluster, log_line)
    assert "Dask's dashboard: http://127.0.0.1:" in caplog.text


def test_what_is_done_is_not_done_again(record_drive: RecordDrive, tmp_path: Path):
    session, out = record_drive(scans=10), tmp_path / "out"
    config = tmp_path / "c.yaml"
    config.write_text("mapping: {cell_m: 0.05}\nsensors: {front: {type: sick_lms100, host: a}}\n")

    def was_done(options: ReplayOptions, is_again: bool = False) -> bool:
        (done,) = run_all(new_tasks([[session]], options, [out], is_again=is_again))
        assert isinstance(done.outcome, dict)
        return done.was_done

    assert not was_done(ReplayOptions())
    first = results_in(out)
    assert was_done(ReplayOptions())
    assert not was_done(ReplayOptions(), is_again=True)
    assert results_in(out) == first
    assert not was_done(ReplayOptions(config=config))
    assert was_done(ReplayOptions(config=config))
    config.write_text(config.read_text().replace("0.05", "0.1"))
    assert not was_done(ReplayOptions(config=config))
    (out / DONE_FILE).write_text("{")
    assert not was_done(ReplayOptions(config=config))
    record_drive(name="w", scans=11).replace(session)
    assert not was_done(ReplayOptions(config=config))
    replay_to([session], ReplayOptions(), out)
    assert not was_done(ReplayOptions(config=config))


def test_a_result_that_is_only_begun_counts_as_not_done(record_drive: RecordDrive, tmp_path: Path):
    session, bad = record_drive(scans=10), tmp_path / "bad.yaml"
    bad.write_text("mapping: {profile: none_such}\n")
    assert isinstance(run_all(new_tasks([[session]], ReplayOptions(), [tmp_path / "out"]))[0].outcome, dict)
    (failed,) = run_all(new_tasks([[session]], ReplayOptions(config=bad), [tmp_path / "out"]))
    assert isinstance(failed.outcome, CorridorError)
    assert not (tmp_path / "out" / DONE_FILE).exists()


def test_a_worker_with_other_sources_is_refused(record_drive: RecordDrive, tmp_path: Path):
    (task,) = new_tasks([[record_drive(scans=1)]], ReplayOptions(), [tmp_path / "out"])
    (done,) = run_all([replace(task, program="of another wheel")])
    assert "install the same wheel on every node" in str(done.outcome)


def test_a_fault_of_the_program_is_the_outcome_of_its_session(
    record_drive: RecordDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("service.offline.cluster.session_task.replay_to", lambda *_: 1 / 0)
    (done,) = run_all(new_tasks([[record_drive(scans=1)]], ReplayOptions(), [tmp_path / "out"]))
    assert "this is a fault of the program\nTraceback" in str(done.outcome)
    assert "ZeroDivisionError" in str(done.outcome)


def test_the_command_tells_how_far_it_is_and_writes_one_table(
    record_drive: RecordDrive, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    bad = tmp_path / "in" / "bad.mcap"
    requested = ["replay", str(record_drive(scans=10).parent), "--out", str(tmp_path / "out"), "--jobs", "1"]
    bad.write_text("no recording")
    assert main([*requested, "--json"]) == InputError.exit_code
    assert "2 of 2 sessions, 1 failed" in capfd.readouterr().err
    table = parquet.read_table(tmp_path / "out" / TABLE_FILE).to_pylist()
    assert [(row["session"], row["scans"]) for row in table] == [
        (str(bad), None),
        (str(next((tmp_path / "in").glob("v_*"))), 10),
    ]
    assert "bad.mcap is no recording" in table[0]["error"]
    assert (table[1]["ok"], table[1]["error"], len(table[1]["warnings"])) == (10, None, 1)
    assert table[1]["input"][0].startswith("sha256 ")
    summary = json.loads((Path(table[1]["result"]) / "summary.json").read_text())
    assert table[1]["scan_ms_p50"] == summary["scan_ms"]["p50"]
    assert main(requested) == InputError.exit_code
    assert "1 of 2 sessions are done already" in capfd.readouterr().err


@pytest.mark.parametrize("cluster", ["local:0", "local:two", "k8s:4", "10.0.0.1:8786", "slurm:"])
def test_another_kind_of_cluster_is_refused_by_a_sentence(cluster: str, capfd: pytest.CaptureFixture[str]):
    assert main(["replay", "a.mcap", "--cluster", cluster]) == UsageError.exit_code
    assert "expected local:N (processes of this machine), slurm:N (jobs)" in capfd.readouterr().err


@pytest.mark.soak
def test_slurm_starts_workers_by_dask_jobqueue_whose_results_are_the_same_bytes(
    record_drive: RecordDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """An sbatch that runs the job here and at once."""
    sbatch, scancel = tmp_path / "bin" / "sbatch", tmp_path / "bin" / "scancel"
    sbatch.parent.mkdir()
    sbatch.write_text(
        f"#!/bin/sh\ncp $1 {tmp_path}/job\nsetsid sh {tmp_path}/job >/dev/null 2>&1 &\n"
        "echo Submitted batch job $!\n"
    )
    scancel.write_text("#!/bin/sh\nkill -- -$1\n")
    sbatch.chmod(0o755)
    scancel.chmod(0o755)
    monkeypatch.setenv("PATH", f"{sbatch.parent}:{os.environ['PATH']}")
    settings = {"cores": 1, "memory": "2GB", "interface": "lo"}
    dask.config.set({f"jobqueue.slurm.{name}": value for name, value in settings.items()})
    here, by_job = tmp_path / "here", tmp_path / "by_job"
    one, other = new_tasks([[record_drive(scans=10)]] * 2, ReplayOptions(), [here, by_job])
    run_all([one])
    with Cluster("slurm:1") as cluster:
        run_all([other], cluster)
    assert results_in(by_job) == results_in(here) != {}
