"""`corridor site build`: one map of all drives of a site, which grows by new ones."""

import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from drivers.counted import counted
from service.errors import CorridorError, InputError, UsageError
from service.geometry import poses as se2
from service.interruption import before_ending
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapstore.files import is_map_folder, load_map, only_writer, save_map, versions_of
from service.offline.cluster.batch import run_batch
from service.offline.cluster.engines import Engine
from service.offline.cluster.session_task import new_tasks
from service.offline.maps.changed_places import (
    ChangedPlace,
    ChangedPlaces,
    read_changed_places,
    write_changed_places,
)
from service.offline.replay.replay import Outcome
from service.offline.replay.setup import ReplayOptions
from service.offline.score.trajectory import Trajectory
from service.offline.site.changes import Change, Layers, in_words, log_odds_elsewhere
from service.offline.site.growth import Member, Progress, Site, grow, member_of
from service.offline.site.kept import KEPT, Seen, read_kept, write_kept
from service.offline.site.manifest import LeftOut, read_manifest, write_manifest
from service.offline.site.paths import PATHS, write_paths
from service.offline.site.sessions import Given, Session, digest_of, given_sessions, load_session
from service.offline.writing import refuse_unwritable_folder

SESSIONS = "sessions"  # below the map: results of recordings that were replayed for it
WORK = ".build"  # below the map: of the build at work
LEFTOVERS = ".corridor-*"  # folders of files that are not complete


def site_build(
    paths: Sequence[Path],
    options: ReplayOptions,
    out: Path,
    engine: Engine,
    progress: Progress,
    joined: Collection[str] = (),
    forgotten: Collection[str] = (),
) -> dict[str, Any]:
    """Add sessions to the site map in `out`, or begin one; its outcome, for JSON: with the exit codes of the
    recordings given that could not be mapped, `failed`.

    joined     names of sessions that are added also where the others contradict them

    forgotten  names of sessions that were left out, and are named no more

    Raises UsageError where `joined` names no session, or `forgotten` none that was left out, InputError where
    `out` holds another map or no session can be used, StorageError where it cannot be written, and what a
    task failed by.
    """
    refuse_unwritable_folder(out)
    site, left_out, number = _site_there(out)
    kept = {} if site is None else _kept_of(site, out)
    old = [] if site is None else list(site.members)
    in_site = {one.name: one.digest for one in old}
    given, passed_over = given_sessions(paths, out, out / SESSIONS, in_site)
    if unknown := sorted(set(joined) - {one.name for one in given}):
        names = ", ".join(one.name for one in given)
        raise UsageError(f"--join {unknown[0]}: no such session among those given, which are {names}")
    given = [one for one in given if in_site.get(one.name) != one.digest]
    if unknown := sorted(set(forgotten) - left_out.keys()):
        names = ", ".join(left_out) or "none"
        raise UsageError(f"--forget {unknown[0]}: no such session among those left out, which are {names}")
    left_out = {
        name: one for name, one in left_out.items() if name not in {*joined, *forgotten} and one.digest
    }
    with _at_work(out):
        for leftover in (path for folder in (PATHS, KEPT, "") for path in (out / folder).glob(LEFTOVERS)):
            shutil.rmtree(leftover)
        replayed = _replayed(given, options, engine, progress)
        failed = {name: each for name, each in replayed.items() if isinstance(each, CorridorError)}
        refused = {name: LeftOut("", 0, str(error)) for name, error in failed.items()}
        sessions = _fresh_of([one for one in given if one.name not in failed], old, left_out, refused)
        if site is None:
            if not sessions:
                raise next(iter(failed.values()), InputError("; ".join(one.why for one in refused.values())))
            site = _begun(sessions, engine, out / WORK, progress, joined)
        else:
            known = {
                one.name: left_out[one.name].known
                for one in sessions
                if one.name in left_out and left_out[one.name].digest == one.digest
            }
            grow(site, sessions, engine, out / WORK, progress, known, joined)
        digests = {one.name: one.digest for one in sessions}
        refused |= {
            name: LeftOut(digests[name], len(site.members), why) for name, why in site.left_out.items()
        }
        left_out = {name: one for name, one in left_out.items() if name not in digests} | refused
        write_manifest(out, site.members, left_out)
        added = len(site.members) - len(old)
        number = _written(site, out, number, added, {one.name: one.result for one in given}, kept)
    changed = read_changed_places(out, number)
    report = _report(site, left_out, out, number, added, changed)
    of_replays = [
        f"{name}: {words}"
        for name, outcome in replayed.items()
        if not isinstance(outcome, CorridorError)
        for words in outcome["warnings"]
    ]
    return report | {
        "failed": {name: error.exit_code for name, error in failed.items()},
        "warnings": [*passed_over, *of_replays, *_uncertain(changed)],
    }


@contextmanager
def _at_work(out: Path) -> Iterator[None]:
    """Only build of the site; however it ends, the folder WORK is gone, and a new `out` that is empty. What
    was replayed stays: the next build takes it.
    """
    is_new, is_at_work = not out.exists(), True

    def clear() -> None:
        if is_at_work:
            shutil.rmtree(out / WORK, ignore_errors=True)
            if is_new:
                with suppress(OSError):  # it is not empty
                    out.rmdir()

    with only_writer(out / WORK, out):
        before_ending(clear)
        try:
            yield
        finally:
            clear()
            is_at_work = False


def _written(
    site: Site,
    out: Path,
    number: int,
    added: int,
    results: Mapping[str, Path],
    kept: Mapping[str, tuple[Seen, Trajectory]],
) -> int:
    """Write the map, where sessions were added to version `number`, and what lies beside it; its number.

    changes.json is last: one of another version shows that a build broke off, or that the map was edited.
    """
    changed = read_changed_places(out, number)
    if not added and changed is not None and changed.version == number:
        return number
    if added and len(site.members) == 1:
        site.solve()
    layers, compared = site.layers()
    known_paths = {name: path for name, (_, path) in kept.items()}
    for name, path in write_paths(out, site, results, known_paths).items():
        if name not in kept or site.kept[name] is not kept[name][0]:
            write_kept(out, name, site.kept[name], path)
    if added:
        if number and versions_of(out)[1] != number:
            raise InputError(
                f"{out}: the map was changed during the build; repeat it, nothing is replayed again"
            )
        number = _save(site, layers, out)
    places = [_changed_place(change, site) for change in layers.changes]
    of_sessions = {
        site.members[k].name: {"places": one.places, "gone": one.places_gone, "new": one.places_new}
        for k, one in compared.items()
    }
    write_changed_places(out, ChangedPlaces(number, site.cell_m, places, of_sessions))
    return number


def _fresh_of(
    given: Sequence[Given],
    old: Sequence[Member],
    left_out: Mapping[str, LeftOut],
    refused: dict[str, LeftOut],
) -> list[Session]:
    """Those that the site does not have yet; what cannot be used goes into `refused`."""
    sessions: list[Session] = []
    for one in given:
        try:
            if (fresh := _fresh(one, old, left_out)) is not None:
                _refuse_again(fresh, [*old, *map(member_of, sessions)])
                sessions.append(fresh)
        except InputError as error:
            refused[one.name] = LeftOut("", 0, str(error))
    return sessions


def _site_there(out: Path) -> tuple[Site | None, dict[str, LeftOut], int]:
    """The site, who was left out of it, and the version of its map. None: nothing was built there."""
    if not is_map_folder(out):
        return None, {}, 0
    stored = load_map(out)
    if stored.problems:
        raise InputError(
            f"{'; '.join(stored.problems)}; remove the folder of that version to continue from version "
            f"{stored.number}, and name the sessions again that were added since"
        )
    members, left_out = read_manifest(out, stored)
    assert stored.graph is not None
    return Site(members, stored.graph, stored.cell_m, stored.geo), left_out, stored.number


def _kept_of(site: Site, out: Path) -> dict[str, tuple[Seen, Trajectory]]:
    """What the members saw, which the site gets, and their paths, by name, as far as they are kept."""
    kept = {member.name: one for member in site.members if (one := read_kept(out, member.name)) is not None}
    site.kept = {name: seen for name, (seen, _) in kept.items()}
    return kept


def _replayed(
    given: Sequence[Given], options: ReplayOptions, engine: Engine, progress: Progress
) -> dict[str, Outcome]:
    """Replay what is not mapped, as tasks; the outcome of each, by name."""
    todo = [one for one in given if one.recording]
    tasks = new_tasks([one.recording for one in todo], options, [one.result for one in todo])
    done = run_batch(tasks, engine, progress) if tasks else []
    return {one.name: each.outcome for one, each in zip(todo, done, strict=True)}


def _fresh(given: Given, members: Sequence[Member], left_out: Mapping[str, LeftOut]) -> Session | None:
    """The session, unless it was left out when the site had the same members. Raises InputError where it
    cannot be used.
    """
    known = left_out.get(given.name)
    if known is not None and (known.digest, known.known) == (digest_of(given.result), len(members)):
        return None
    return load_session(given)


def _refuse_again(session: Session, others: Sequence[Member]) -> None:
    """Raises InputError where another one is of the same drive: each would confirm the other's errors."""
    own = member_of(session)
    if same := next((one for one in others if one.stamps_ns == own.stamps_ns), None):
        raise InputError(
            f"it is the drive of {same.name}, by the stamps of its key frames; if it was edited or replayed "
            "again since, and that is to count, build a new site"
        )


def _begun(
    sessions: Sequence[Session],
    engine: Engine,
    folder: Path,
    progress: Progress,
    joined: Collection[str],
) -> Site:
    """A new site: the most of the sessions that fit together, in the map frame of the first of them."""
    rest, best, sites = list(sessions), None, dict[str, Site]()
    while rest and (best is None or len(best.members) < len(rest)):
        site = Site([member_of(rest[0])], rest[0].graph, rest[0].cell_m)
        grow(site, rest[1:], engine, folder, progress, joined=joined)
        sites |= dict.fromkeys((one.name for one in site.members), site)
        if best is None or len(site.members) > len(best.members):
            best = site
        rest = [one for one in rest if one.name not in sites]
    assert best is not None
    best.left_out = {
        one.name: _why_apart(one.name, sites[one.name], best)
        if one.name in sites
        else best.left_out[one.name]
        for one in sessions
        if sites.get(one.name) is not best
    }
    return best


def _why_apart(name: str, site: Site, best: Site) -> str:
    """Why a session is not in the best site but in another one."""
    if against := [one.name for one in best.members if one.name in site.elsewhere]:
        return f"{against[0]}, of the larger group, contradicts it: {site.elsewhere[against[0]]}"
    others = ", ".join(one.name for one in site.members if one.name != name)
    if not others:
        return "it overlaps with no other session"
    return f"it overlaps with {others} alone: a site of its own, or the drive between is missing"


def _save(site: Site, layers: Layers, out: Path) -> int:
    """The number of the new version."""
    shown = OccupancyTiles(OccupancyConfig(), site.cell_m)
    shown.replace_by(layers.newest(site.rendered(shown.renderer)), ())
    about = {"profile": "corridor", "sessions": str(len(site.members))}
    saved_ns = int(site.graph.stamp_ns.max())
    number = save_map(out, shown.changed_tiles(), saved_ns, about, site.geo, site.graph)
    if number is None:
        raise InputError(f"{out}: no key frame of the site saw anything; the map has no tile")
    return number


def _changed_place(change: Change, site: Site) -> ChangedPlace:
    first, last, now = (site.members[k] for k in (*change.seen, change.session))
    x_m, y_m = ((change.cells[:, ::-1].mean(axis=0) + 0.5) * site.cell_m).tolist()
    return ChangedPlace(
        "new" if change.is_new else "gone",
        round(x_m, 2),
        round(y_m, 2),
        round(len(change.cells) * site.cell_m**2, 4),
        first.stamps_ns[0],
        last.stamps_ns[1],
        list(dict.fromkeys((first.name, last.name))),
        now.stamps_ns[0],
        now.name,
        change.cells[:, ::-1].tolist(),
    )


def _report(
    site: Site,
    left_out: Mapping[str, LeftOut],
    out: Path,
    number: int,
    added: int,
    changed: ChangedPlaces | None,
) -> dict[str, Any]:
    graph, ends = site.graph, site.members_of_loops()
    seen = se2.between(graph.map[graph.loop_ends[:, 0]], graph.map[graph.loop_ends[:, 1]])
    off_mm = 1e3 * np.hypot(*se2.between(graph.loop_measured, seen)[:, :2].T)
    sessions = []
    for k, one in enumerate(site.members):
        own = (ends[:, 0] != ends[:, 1]) & (ends == k).any(axis=1)
        sessions.append(
            {
                "session": one.name,
                "keyframes": one.keyframes,
                "loops": int(own.sum()),
                "sessions_joined": len({*ends[own].ravel().tolist()} - {k}),
                "residual_mm": round(float(np.sqrt((off_mm[own] ** 2).mean())), 1) if own.any() else None,
                **dict.fromkeys(("places", "gone", "new")),
                **(changed.compared.get(one.name, {}) if changed is not None else {}),
                "fixes": 0 if one.geo is None else one.geo.fixes,
            }
        )
    return {
        "map": str(out),
        "version": number,
        "added": added,
        "sessions": sessions,
        "left_out": {name: one.why for name, one in sorted(left_out.items())},
        "keyframes": len(graph),
        "loops": len(graph.loop_ends),
        "loops_contradicted": site.contradicted,
        "changed_places": 0 if changed is None else len(changed.places),
    }


def _uncertain(changed: ChangedPlaces | None) -> list[str]:
    """A warning for each session that looks as if it were of another place, and is in the map."""
    compared = {} if changed is None else changed.compared
    return [
        f"{name}: {in_words(**one)}: another floor of the same plan, or much was moved. Compare the two by "
        f"corridor view; if it is another floor, build the site without {name} in another --out"
        for name, one in compared.items()
        if log_odds_elsewhere(**one) > 0.0
    ]


def summary_of(report: Mapping[str, Any]) -> str:
    """In words, a line."""
    count, left_out = len(report["sessions"]), report["left_out"]
    words = f"{report['map']}, version {report['version']}: {counted(count, 'session')} of the site"
    words += f", {report['added']} of them new" if report["added"] != count else ""
    if report["changed_places"]:
        words += f"; {counted(report['changed_places'], 'changed place')}"
    if left_out:
        words += f"; {len(left_out)} left out: {', '.join(left_out)}"
    if report["warnings"]:
        words += f"; {counted(len(report['warnings']), 'warning')}"
    return words


def site_table(report: Mapping[str, Any]) -> list[list[str]]:
    """Rows for a terminal, the first one the heads."""
    columns = {
        "session": "session",
        "key frames": "keyframes",
        "loops": "loops",
        "to sessions": "sessions_joined",
        "residual mm": "residual_mm",
        "places": "places",
        "gone": "gone",
        "new": "new",
        "fixes": "fixes",
    }
    shown = [[one[name] for name in columns.values()] for one in report["sessions"]]
    return [[*columns], *(["-" if value is None else str(value) for value in row] for row in shown)]
