"""replay, import, recover, export, view, score: work on files."""

import argparse
import sys
import threading
from collections.abc import Sequence
from typing import Any

from service.cli.console import print_report, print_result, print_table, progress
from service.errors import UsageError
from service.kernel_cache import ensure_cache_dir


def replay(parsed: argparse.Namespace) -> int:
    ensure_cache_dir()
    from service.offline.replay import ReplayOptions, group_sessions, replay_all, result_folders

    sessions = group_sessions(parsed.files)
    folders = result_folders(sessions, parsed.out)
    if parsed.out is None:
        print(f"results go to {' and '.join(map(str, folders))}; --out names another folder", file=sys.stderr)
    options = ReplayOptions(
        parsed.config, parsed.profile, parsed.rate, parsed.map, parsed.localize, parsed.from_raw
    )
    with progress("mapping") as shown:
        summaries = replay_all(sessions, options, folders, parsed.jobs, shown)
    told = [summary | {"out": str(out)} for summary, out in zip(summaries, folders, strict=True)]
    if not parsed.json:
        print_table(_table(told))
    elif len(told) == 1:
        print_result(told[0], as_json=True)
    else:
        print_result(
            {str(session[0]): one for session, one in zip(sessions, told, strict=True)}, as_json=True
        )
    return 0


def _table(summaries: Sequence[dict[str, Any]]) -> list[list[str]]:
    """What one wants to know at once; all of it stands in summary.json of each folder."""
    rows = [
        ["result in", "duration_s", "x real time", "scans", "dropped", "lost", "scan_ms p50", "p99", "loops"]
    ]
    for told in summaries:
        rows.append(
            [
                str(told["out"]),
                f"{told['duration_s']:.1f}",
                f"{told['realtime_factor']:.1f}",
                str(told["scans"]),
                str(told["scans_dropped"]),
                str(told["state"]["lost"]),
                f"{told['scan_ms']['p50']:.2f}",
                f"{told['scan_ms']['p99']:.2f}",
                str(told["loop_closures"]),
            ]
        )
    return rows


def import_log(parsed: argparse.Namespace) -> int:
    if parsed.kind == "rosbag":
        from service.offline.rosbag import import_rosbag

        print_report(import_rosbag(parsed.log, parsed.out), parsed.json)
        return 0
    from service.offline.carmen import import_carmen

    print_report(import_carmen(parsed.log, parsed.out, parsed.odometry), parsed.json)
    return 0


def recover(parsed: argparse.Namespace) -> int:
    from service.recording.mcap_recovery import recover as recover_file

    print_report(recover_file(parsed.file), parsed.json)
    return 0


def export(parsed: argparse.Namespace) -> int:
    from service.offline.export import export as export_file

    export_file(parsed.input, parsed.format, parsed.out)
    print_result({"input": str(parsed.input), "format": parsed.format, "out": str(parsed.out)}, parsed.json)
    return 0


def view(parsed: argparse.Namespace) -> int:
    from service.offline.view import open_view
    from service.web.config import split_listen

    try:
        split_listen(parsed.listen)
    except ValueError as error:
        raise UsageError(f"--listen {parsed.listen}: {error}") from error
    server = open_view(parsed.source, parsed.listen)
    try:
        print_result({"source": str(parsed.source), "address": server.address}, parsed.json)
        sys.stdout.flush()
        threading.Event().wait()  # until a signal
    except KeyboardInterrupt:
        return 0
    finally:
        server.close()
    return 0


def score(parsed: argparse.Namespace) -> int:
    from service.offline.score import score as score_trajectory

    scored = score_trajectory(parsed.estimate, parsed.truth, parsed.shift_s, parsed.offset_x, parsed.pairs)
    print_report(scored, parsed.json)
    return 0
