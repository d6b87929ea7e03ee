"""replay, import, recover, export, report, view, score, calibrate, site build: work on files."""

import argparse
import json
import logging
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.archive import path_or_url
from service.cli.console import print_report, print_result, print_table, progress
from service.cli.recordings import choice_of
from service.compile.cache import ensure_cache_dir
from service.errors import CorridorError, UsageError
from service.interruption import leave_signals_alone
from service.log_format import printable
from service.readable import refuse_unreadable

if TYPE_CHECKING:
    from service.offline.cluster.engines import Engine
    from service.offline.past.past_page import RecordingView
    from service.offline.past.replay_page import ReplayPage
    from service.offline.past.view import View
    from service.offline.replay.replay import Outcome


log = logging.getLogger(__name__)


def replay(parsed: argparse.Namespace) -> int:
    ensure_cache_dir()
    from service.offline.cluster.batch import run_batch, write_table
    from service.offline.cluster.session_task import new_tasks
    from service.offline.replay.replay import DEFAULT_OUT, group_sessions, replay_all, result_folders
    from service.offline.replay.setup import ReplayOptions, refuse_contradictions

    folder, version = parsed.map or (None, None)
    options = ReplayOptions(
        config=parsed.config,
        profile=parsed.profile,
        rate=parsed.rate,
        map=folder,
        version=version,
        localize=parsed.localize,
        choice=choice_of(parsed),
        from_raw=parsed.from_raw,
    )
    refuse_contradictions(options)
    sessions = group_sessions([path_or_url(one) for one in parsed.files])
    out = None if parsed.out is None else path_or_url(parsed.out)
    is_batch = parsed.jobs is not None or parsed.cluster is not None
    folders = result_folders(sessions, out, is_batch)
    if out is None:
        where = " and ".join(map(str, folders))
        print(printable(f"results go to {where}; --out names another folder"), file=sys.stderr)
    if is_batch:
        if parsed.web or parsed.paused:
            raise UsageError("--web shows one recording after the other; leave --jobs and --cluster out")
        tasks = new_tasks(sessions, options, folders, parsed.extras, parsed.again)
        with engine_of(parsed) as engine, progress("mapping") as shown:
            done = run_batch(tasks, engine, shown)
        outcomes = [one.outcome for one in done]
        _tell_outcomes([str(session[0]) for session in sessions], outcomes, folders, parsed.json)
        if (table := write_table(out or DEFAULT_OUT, tasks, done)) is not None:
            print(f"summaries of all sessions: {table}", file=sys.stderr)
        return next((one.exit_code for one in outcomes if isinstance(one, CorridorError)), 0)
    if parsed.again:
        raise UsageError("--again: without --jobs or --cluster everything is replayed again anyway")
    with _page_of(parsed, sessions) as page:
        with progress("mapping") as shown:
            outcomes = replay_all(sessions, options, folders, shown, page, parsed.extras)
        failed = [outcome for outcome in outcomes if isinstance(outcome, CorridorError)]
        if failed and len(sessions) == 1:
            raise failed[0]
        _tell_outcomes([str(session[0]) for session in sessions], outcomes, folders, parsed.json)
        if page is not None and len(failed) < len(sessions):
            sys.stdout.flush()
            leave_signals_alone()  # all is written: from here on Ctrl-C is how one leaves
            with suppress(KeyboardInterrupt):
                print(f"{page.address} stays until Ctrl-C", file=sys.stderr, flush=True)
                threading.Event().wait()
    return failed[0].exit_code if failed else 0


@contextmanager
def engine_of(parsed: argparse.Namespace) -> Iterator["Engine"]:
    """Where tasks run, by --jobs and --cluster. Raises UsageError."""
    from service.offline.cluster.engines import Cluster, Processes, in_turn

    if parsed.cluster is not None:
        with Cluster(parsed.cluster) as cluster:
            yield cluster
    elif (parsed.jobs or 1) > 1:
        with Processes(parsed.jobs) as processes:
            yield processes
    else:
        yield in_turn


def _tell_outcomes(
    names: Sequence[str], outcomes: Sequence["Outcome"], folders: Sequence[Path], as_json: bool
) -> None:
    """A table of what was mapped and, on stderr, why the others were not; or all of it as JSON. Last, on
    stderr, why scans were degraded or lost; of several sessions all warnings, each with its session.
    """
    from service.offline.replay.figures import doubts

    facts: dict[str, dict[str, Any]] = {}
    for name, outcome, folder in zip(names, outcomes, folders, strict=True):
        if isinstance(outcome, CorridorError):
            print(printable(f"corridor: {outcome}"), file=sys.stderr)
            facts[name] = {"error": str(outcome)}
        else:
            facts[name] = outcome | {"out": str(folder)}
    if as_json:
        print_result(facts if len(facts) > 1 else facts[names[0]], as_json=True)
    elif mapped := [summary for summary in facts.values() if "out" in summary]:
        print_table(_table(mapped))
    sys.stdout.flush()
    for name, outcome in zip(names, outcomes, strict=True):
        if isinstance(outcome, CorridorError):
            continue
        for warning in outcome["warnings"] if len(names) > 1 else doubts(outcome):
            log.warning("%s: %s", name, warning)


@contextmanager
def _page_of(parsed: argparse.Namespace, sessions: Sequence[Sequence[Path]]) -> Iterator["ReplayPage | None"]:
    """The page that shows the replay, None where none is requested."""
    if not parsed.web:
        if parsed.paused:
            raise UsageError("--paused: the page is where it is begun; give --web, too")
        yield None
        return
    from service.offline.past.replay_page import ReplayPage
    from service.recording.opening import name_of

    check_listen(parsed.listen)
    page = ReplayPage(parsed.listen, name_of(sessions[0][0]), parsed.rate, parsed.paused)
    try:
        print(f"The map, live: {page.address}", file=sys.stderr, flush=True)
        yield page
    finally:
        page.close()


def check_listen(listen: str) -> None:
    """Raises UsageError."""
    from service.web.config import split_listen

    try:
        split_listen(listen)
    except ValueError as error:
        raise UsageError(f"--listen {listen}: {error}") from error


def _table(summaries: Sequence[dict[str, Any]]) -> list[list[str]]:
    """What one wants to know at once; all of it stands in summary.json of each folder."""
    rows = [
        ["result in", "duration_s", "x real time", "scans", "dropped", "lost", "scan_ms p50", "p99", "loops"]
    ]
    for facts in summaries:
        rows.append(
            [
                str(facts["out"]),
                f"{facts['duration_s']:.1f}",
                f"{facts['realtime_factor']:.1f}",
                str(facts["scans"]),
                str(facts["scans_dropped"]),
                str(facts["state"]["lost"]),
                f"{facts['scan_ms']['p50']:.2f}",
                f"{facts['scan_ms']['p99']:.2f}",
                str(facts["loop_closures"]),
            ]
        )
    return rows


def import_log(parsed: argparse.Namespace) -> int:
    if parsed.kind == "rosbag":
        from service.offline.importing.rosbag import import_rosbag

        print_report(import_rosbag(parsed.log, parsed.out, choice_of(parsed)), parsed.json)
        return 0
    from service.offline.importing.carmen import import_carmen

    print_report(import_carmen(parsed.log, parsed.out, parsed.odometry), parsed.json)
    return 0


def recover(parsed: argparse.Namespace) -> int:
    from service.recording.mcap_recovery import recover as recover_file

    print_report(recover_file(parsed.file), parsed.json)
    return 0


def export(parsed: argparse.Namespace) -> int:
    from service.offline.export.export import export as export_file

    export_file(parsed.input, parsed.format, parsed.out)
    print_result({"input": str(parsed.input), "format": parsed.format, "out": str(parsed.out)}, parsed.json)
    return 0


def report(parsed: argparse.Namespace) -> int:
    from service.offline.report import REPORT_FILE, write_report

    out: Path = parsed.out or parsed.result / REPORT_FILE
    write_report(parsed.result, out)
    print_result({"result": str(parsed.result), "out": str(out)}, parsed.json)
    return 0


def view(parsed: argparse.Namespace) -> int:
    first, *more = parsed.source
    from service.offline.past.result import is_ros_map
    from service.recording.opening import is_recording

    recorded = (first.is_file() and not is_ros_map(first)) or is_recording(first)
    if more and not recorded:
        raise UsageError("several files are one recording; of folders give one")
    if parsed.rerun and recorded:
        raise UsageError("--rerun shows maps and results; a recording is opened by rerun itself")
    refuse_unreadable(first)
    if parsed.rerun:
        from service.offline.export.rerun_view import show_in_rerun

        show_in_rerun(first, parsed.save)
        where = "the viewer of rerun" if parsed.save is None else str(parsed.save)
        print_result({"source": str(first), "shown_in": where}, parsed.json)
        return 0
    if parsed.save is not None:
        raise UsageError("--save: a recording is written for rerun; give --rerun, too")
    check_listen(parsed.listen)
    shown = _view_of(parsed, recorded)
    try:
        print_result({"source": str(first), "address": shown.address}, parsed.json)
        sys.stdout.flush()
        threading.Event().wait()  # until a signal
    except KeyboardInterrupt:
        return 0
    finally:
        shown.close()
    return 0


def _view_of(parsed: argparse.Namespace, recorded: bool) -> "RecordingView | View":
    if not recorded:
        from service.offline.past.view import View

        return View(parsed.source[0], parsed.listen)
    from service.offline.past.past_page import RecordingView

    with progress("reading") as shown:
        return RecordingView(parsed.source, parsed.listen, shown)


def score(parsed: argparse.Namespace) -> int:
    from service.offline.score.score import score as score_trajectory

    scored = score_trajectory(parsed.estimate, parsed.truth, parsed.shift_s, parsed.offset_x, parsed.pairs)
    print_report(scored, parsed.json)
    return 0


def site(parsed: argparse.Namespace) -> int:
    ensure_cache_dir()
    from service.offline.replay.setup import ReplayOptions
    from service.offline.site.build import site_build, site_table, summary_of

    if not parsed.sessions and not parsed.forget:
        raise UsageError("name the sessions to add: recordings, results, or a folder of them")
    options = ReplayOptions(config=parsed.config, choice=choice_of(parsed))
    paths = [path_or_url(one) for one in parsed.sessions]
    with engine_of(parsed) as engine, progress("site build") as shown:
        report = site_build(paths, options, parsed.out, engine, shown, parsed.join, parsed.forget)
    if parsed.json:
        print_result(report, as_json=True)
    else:
        print_table(site_table(report))
        for name, why in report["left_out"].items():
            print(printable(f"left out: {name}: {why}"))
        for warning in report["warnings"]:
            print(printable(f"warning: {warning}"))
        print(printable(summary_of(report)))
    exit_code: int = next(iter(report["failed"].values()), 0)
    return exit_code


def calibrate(parsed: argparse.Namespace) -> int:
    ensure_cache_dir()
    from service.cli.recordings import choice_of
    from service.offline.calibrate.calibrate import calibrate as calibrate_by
    from service.offline.importing.session_file import refuse_to_overwrite
    from service.offline.writing import complete_files, refuse_unwritable_file

    if parsed.out is not None:
        for path in parsed.files:
            refuse_to_overwrite(path, parsed.out)
        refuse_unwritable_file(parsed.out)
    with progress("calibrate") as shown:
        done = calibrate_by(parsed.files, parsed.config, parsed.reference, shown, choice_of(parsed))
    if parsed.out is not None:
        with complete_files(parsed.out) as path:
            path.write_text(done.config or done.patch, encoding="utf-8")
    print(json.dumps(asdict(done), allow_nan=False) if parsed.json else printable(done))
    return 0
