"""tune: settings of a profile by a search over sessions."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from service.archive import is_remote, path_or_url
from service.cli.console import print_result, progress
from service.cli.recordings import choice_of
from service.cli.sessions import engine_of
from service.compile.cache import ensure_cache_dir
from service.errors import InputError, UsageError
from service.readable import refuse_unreadable
from service.recording.opening import name_of


def tune(parsed: argparse.Namespace) -> int:
    ensure_cache_dir()
    from service.mapper.profiles import begins_in_stored
    from service.offline.replay.replay import group_sessions
    from service.offline.replay.setup import ReplayOptions, set_up
    from service.offline.replay.setup import choice_of as topics_of
    from service.offline.tune.page import PAGE_FILE, PATCH_FILE, write_outcome
    from service.offline.tune.search import Drive
    from service.offline.tune.search import tune as search
    from service.offline.tune.space import parameters_of
    from service.offline.writing import refuse_unwritable_folder
    from service.recording.mcap_source import open_session

    options = ReplayOptions(config=parsed.config, profile=parsed.profile, choice=choice_of(parsed))
    sessions = group_sessions([path_or_url(one) for one in parsed.files])
    truths = truths_of(sessions, parsed.truth)
    samples, faults = set(), list[str]()
    for session in sessions:
        try:
            samples |= {kind for kind, _ in open_session(session, topics_of(options)).topics_of}
        except InputError as error:
            faults.append(str(error))
    if faults:
        raise InputError("\n".join([*faults, "leave them out: a search is over sessions that can be mapped"]))
    mapping = set_up(open_session(sessions[0], topics_of(options)), options).mapping
    if parsed.truth is None and not begins_in_stored(mapping):
        raise UsageError(
            f"--self: the profile {mapping.profile} stores no pose graph, by which a result is measured "
            "without a truth; give --truth, or --profile corridor"
        )
    parameters = parameters_of(mapping, parsed.parameter, samples)
    if is_remote(out := path_or_url(parsed.out)):
        raise UsageError(f"--out {out}: the state of a search is on a disk; give a folder")
    refuse_unwritable_folder(out)
    drives = [
        Drive(tuple(session), truth, is_held_out=not parsed.all and k % 2 == 1)
        for k, (session, truth) in enumerate(zip(sessions, truths, strict=True))
    ]
    with engine_of(parsed) as engine, progress("trials") as shown:
        outcome = search(drives, options, parameters, out, parsed.trials, parsed.seed, engine, shown)
    write_outcome(outcome, mapping.profile, out)
    result = {
        "present": outcome.present,
        "best": outcome.best,
        "sessions": {
            one.name: {
                "held_out": one.is_held_out,
                "present": asdict(outcome.measured[one.name][0]),
                "best": asdict(outcome.measured[one.name][1]),
            }
            for one in drives
        },
        "page": str(out / PAGE_FILE),
        "patch": str(out / PATCH_FILE),
    }
    if parsed.json:
        print_result(result, as_json=True)
    else:
        print((out / PATCH_FILE).read_text(encoding="utf-8"), end="")
        print(f"{out / PAGE_FILE} has the pictures", file=sys.stderr)
    return 0


def truths_of(sessions: Sequence[Sequence[Path]], given: Sequence[Path] | None) -> list[Path | None]:
    """Of each session: None by itself; else the file in the same place, or the file of its name in a folder.

    Raises UsageError, InputError.
    """
    if given is None:
        return [None] * len(sessions)
    if len(given) == 1 and given[0].is_dir():
        found = []
        for session in sessions:
            names = [f"{name_of(session[0])}.{suffix}" for suffix in ("tum", "relations")]
            there = [given[0] / name for name in names if (given[0] / name).is_file()]
            if not there:
                raise InputError(f"{given[0]}: no {' or '.join(names)} in it, the truth of {session[0]}")
            found.append(there[0])
        return list(found)
    if len(given) != len(sessions):
        raise UsageError(
            f"--truth: {len(given)} files for {len(sessions)} sessions; give one for each, in their order, "
            "or a folder of files named like the sessions"
        )
    for truth in given:
        refuse_unreadable(truth)
    return list(given)
