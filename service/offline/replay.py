"""Recordings through the same mapper as the live service: same input, same output, bit for bit."""

import itertools
import json
import logging
import re
import shutil
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drivers.frames import LaserScan
from service.config import (
    ReplayConfig,
    laser_names,
    load_replay_config,
    mapped_lasers,
    mountings,
    parse_replay_config,
)
from service.encoding import LASER_SCAN, pose_on_wire
from service.encoding import warm_up as warm_up_encoding
from service.errors import ConfigError, InputError, StorageError
from service.geometry.geo_reference import GeoReference
from service.geometry.geodesy import UTM_MOST_LATITUDE_DEG
from service.geometry.se2 import SE2
from service.interruption import children_do_not_hear
from service.kernel_warm_up import KernelProgress
from service.kernel_warm_up import warm_up as warm_up_kernels
from service.mapper.components import GraphRequestError
from service.mapper.corrections import corrected
from service.mapper.map_changes import MapChanges
from service.mapper.mapping_session import (
    APPLY_AFTER_SCANS,
    ApplyResult,
    GraphRequest,
    LeftOut,
    LoadMap,
    MappingSession,
    SessionRequest,
    SwitchProfile,
)
from service.mapper.pipeline import Mapper
from service.mapper.profiles import MappingConfig, build_mapper, mapping_config, with_profile
from service.mapper.saved_graph import SavedGraph
from service.mapstore.annotated import PALETTE, annotated
from service.mapstore.begin_in import begin_in
from service.mapstore.files import is_map_folder, save_map
from service.mapstore.geo_file import GEO_FILE, write_geo
from service.mapstore.patch_files import PatchFiles
from service.mapstore.picture import picture_of_tiles
from service.mapstore.png import write_png
from service.mapstore.ros_map import write_ros_map
from service.offline.geo_export import write_world_file
from service.offline.map_change_file import CHANGES_FILE, write_changes
from service.offline.pace import Unwatched, Watch
from service.offline.profile_switches import ProfileSwitches
from service.offline.raw_replay import FROM_RAW, remake_frames
from service.offline.replay_figures import peak_rss_mb, percentiles_ms
from service.offline.trajectory import write_tum
from service.outputs import MapperOutput, TileUpdate
from service.recording.mcap_source import Session, open_session
from service.version import VERSION

log = logging.getLogger(__name__)

Progress = Callable[[float | None, str], None]  # share of a phase, None where nobody knows it; the phase
REMAKING, MAPPING, CLOSING = "decoding", "mapping", "closing loops"  # phases
DEFAULT_OUT = Path("out")
STATES = ("ok", "degraded", "lost")
_SESSION_FILE = re.compile(r"(.+_\d{8}T\d{6}Z)_\d{4}\.mcap")


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """How to replay. Each None leaves it to the recording, which holds the config it was made with."""

    config: Path | None = None
    profile: str | None = None
    rate: float = 0.0  # times real time; 0: as fast as it goes
    map: Path | None = None  # a stored map to begin in
    localize: bool = False  # ... which stays as it is
    from_raw: bool = False  # map what the drivers make of the recorded bytes, not the recorded frames


class StageTimes:
    """Stopwatch of the mapper's stages."""

    def __init__(self) -> None:
        self.laps_ns: defaultdict[str, list[int]] = defaultdict(list)
        self._at_ns = 0

    def start(self) -> None:
        self._at_ns = time.perf_counter_ns()

    def lap(self, stage: str) -> None:
        now_ns = time.perf_counter_ns()
        self.laps_ns[stage].append(now_ns - self._at_ns)
        self._at_ns = now_ns

    def p50_ms(self) -> dict[str, float]:
        return {stage: round(float(np.median(laps)) / 1e6, 3) for stage, laps in self.laps_ns.items()}


@dataclass(slots=True)
class Replay:
    """What came out of one recording."""

    outputs: list[MapperOutput]  # as they would have been published
    poses_map_base: list[SE2]  # of each output, by all that was known in the end
    tiles: list[TileUpdate]  # of the map at the end; after a reset, of the newest
    g2o: str  # its graph; "" where the profile has none
    summary: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    geo: GeoReference | None = None  # where its map lies on the earth; None: that is not known
    graph: SavedGraph | None = None  # with which a later session goes on; None: it cannot
    changes: MapChanges | None = None  # since the map was stored in which it was localised; None: it was not
    session: SavedGraph | None = None  # key frames of that map and of the drive behind them; None likewise


def group_sessions(paths: Sequence[Path]) -> list[list[Path]]:
    """Files that belong to one drive, oldest first: a session may have been cut into several. Folders too.

    Raises InputError for a folder without recordings.
    """
    files: list[Path] = []
    for path in paths:
        found = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        if not found:
            raise InputError(f"{path}: no *.mcap in this folder")
        files += found
    sessions: dict[tuple[Path, str], list[Path]] = {}
    for file in dict.fromkeys(files):
        part_of = _SESSION_FILE.fullmatch(file.name)
        sessions.setdefault((file.parent, part_of[1] if part_of else file.name), []).append(file)
    return [sorted(parts) for parts in sessions.values()]


def result_folders(sessions: Sequence[Sequence[Path]], out: Path | None) -> list[Path]:
    """Where the result of each session goes, no two to the same: one to `out` itself, several to folders
    below it, named after them; without `out` each to out/replay_<name>.
    """
    if out is not None and len(sessions) == 1:
        return [out]
    folders: list[Path] = []
    for session in sessions:
        part_of = _SESSION_FILE.fullmatch(session[0].name)
        name = part_of[1] if part_of else session[0].stem
        folder = out / name if out is not None else DEFAULT_OUT / f"replay_{name}"
        like = (folder.with_name(f"{folder.name}_{number}") for number in itertools.count(2))
        folders.append(folder if folder not in folders else next(one for one in like if one not in folders))
    return folders


def replay_all(
    sessions: Sequence[Sequence[Path]],
    options: ReplayOptions,
    folders: Sequence[Path],
    jobs: int,
    progress: Progress,
    watch: Watch | None = None,
) -> list[dict[str, Any]]:
    """Replay each session and write what `write_replay` says to its folder; their summaries, in order.

    With `jobs` above 1 so many at a time, each in a process of its own; then nobody can watch. Raises
    InputError, ConfigError, StorageError of the first that fails.
    """
    if jobs == 1 or len(sessions) == 1:
        return [
            _replay_to(session, options, folder, _part_of(progress, k, len(sessions)), watch)
            for k, (session, folder) in enumerate(zip(sessions, folders, strict=True))
        ]
    # spawn: a forked child would inherit locks of numba's and of threads that it does not have
    with ProcessPoolExecutor(min(jobs, len(sessions)), mp_context=get_context("spawn")) as pool:
        with children_do_not_hear():
            futures = [
                pool.submit(_replay_to, session, options, folder)
                for session, folder in zip(sessions, folders, strict=True)
            ]
        for done, _ in enumerate(as_completed(futures), start=1):
            progress(done / len(sessions), MAPPING)
        return [future.result() for future in futures]


def replay(
    paths: Sequence[Path],
    options: ReplayOptions,
    progress: Progress = lambda share, phase: None,
    watch: Watch | None = None,
) -> Replay:
    """Map one recording. Raises InputError, ConfigError where the config cannot be used, and StorageError."""
    watch = watch or Unwatched(options.rate)
    if options.from_raw:
        return _replay_from_raw(paths, options, progress, watch)
    session = open_session(paths)
    for note in session.notes:
        log.info("%s", note)
    mapping, poses_base_sensor, lasers, as_live = _setup(session, options)
    stored = None if options.map is None else begin_in(options.map, mapping)
    log.info("mapping the scans of %s", ", ".join(lasers))
    warm_up_encoding()
    compiling = KernelProgress(lambda k: progress(k.share, "compiling kernels"))
    warm_up_kernels(mapping, progress=compiling)
    stages, scan_ns, scan_cpu_ns, states = StageTimes(), [], [], Counter[str]()
    begins = [stored]  # a reset begins a new map, but for a vehicle that is only localised
    switches = ProfileSwitches(mapping, is_followed=options.profile is None)

    def new_mapper() -> Mapper[Any]:
        present = switches.present
        begin = begins[0] if present.mode == "localization" else begins.pop() if begins else None
        return build_mapper(present, poses_base_sensor, stages, new_patch_store=PatchFiles, begin_in=begin)

    mapper = MappingSession(
        new_mapper,
        lasers,
        apply_after=None if as_live else APPLY_AFTER_SCANS,
    )
    tiles: list[TileUpdate] = []
    outputs: list[MapperOutput] = []
    poses: list[SE2] = []  # of the outputs of maps that are finished
    g2o = ""
    geo: GeoReference | None = None
    graph: SavedGraph | None = None

    def finish_map() -> None:
        """Of a map without a scan there is nothing to show: then that before it stands."""
        nonlocal tiles, g2o, geo, graph
        new = outputs[len(poses) :]
        if not new:
            return
        progress(None, CLOSING)
        watch.closing()
        finished = mapper.finish()
        poses.extend(corrected(new, finished.corrections))
        tiles, g2o, geo = mapper.changed_tiles(), finished.g2o, mapper.geo_reference
        saved = finished.update.saved
        graph = saved if isinstance(saved, SavedGraph) else None
        watch.finished(tiles, poses[-len(new) :])

    watch.begin(session, mapper, poses_base_sensor)
    recording = session.recording
    span_ns = max(recording.last_log_ns - recording.first_log_ns, 1)
    left_out: dict[str, LeftOut] = {}  # what live came to the next frame of a sensor
    began_s = time.monotonic()
    for step in session.steps():
        watch.wait_for(step.arrived_ns)
        if isinstance(step, SessionRequest):
            if step.action == "reset_map":
                finish_map()
            mapper.carry_out(step.action)
            continue
        if isinstance(step, LoadMap | SwitchProfile):
            finish_map()
            if isinstance(step, LoadMap):
                begins[:] = [begin_in(Path(step.folder), switches.present, step.version)]
            elif switches.take(step, recording.first_log_ns):
                warm_up_kernels(switches.present, progress=compiling)
            mapper.carry_out("reset_map")
            continue
        if isinstance(step, ApplyResult):
            if as_live:
                mapper.apply_result()
            continue
        if isinstance(step, LeftOut):
            if as_live:
                left_out[step.sensor] = step
            continue
        if isinstance(step, GraphRequest):
            _request(mapper, step)
            continue
        if (reason := left_out.pop(step.sensor, None)) is not None:
            if reason.reason == "old" and isinstance(step, LaserScan):
                mapper.pass_over(step)
            continue
        before_ns, before_cpu_ns = time.perf_counter_ns(), time.thread_time_ns()
        output = mapper.process(step)
        if output is not None and isinstance(step, LaserScan):
            scan_cpu_ns.append(time.thread_time_ns() - before_cpu_ns)
            scan_ns.append(time.perf_counter_ns() - before_ns)
            states[output.state] += 1
            outputs.append(output)
            watch.mapped(step, output)
            progress((step.arrived_ns - recording.first_log_ns) / span_ns, MAPPING)
    progress(1.0, MAPPING)
    finish_map()
    mapper.close()
    wall_s = time.monotonic() - began_s
    if not outputs:
        raise InputError(f"{paths[0]}: not one scan could be mapped ({dict(session.counters)})")
    for topic, devices in session.shared_topics.items():
        log.warning("%s has messages of several frame_ids: %s", topic, _in_words(devices))
    duration_s = (outputs[-1].stamp_ns - outputs[0].stamp_ns) / 1e9
    summary = {
        "corridor": VERSION,
        "profile": switches.present.profile,
        "scans": len(outputs),
        "scans_dropped": _dropped(session, mapper),
        "scans_not_mapped": mapper.counters["scans_not_mapped"],
        "scans_passed_over": mapper.counters["scans_passed_over"],
        "scans_paused": mapper.counters["scans_paused"],
        "shared_topics": session.shared_topics,
        "duration_s": round(duration_s, 3),
        "wall_s": round(wall_s, 3),
        "realtime_factor": round(duration_s / wall_s, 1),
        "scan_ms": percentiles_ms(scan_ns),
        "scan_cpu_ms": percentiles_ms(scan_cpu_ns),
        "stage_ms_p50": stages.p50_ms(),
        "loop_closures": mapper.counters["loop_closures"],
        "keyframes": mapper.counters["keyframes"],
        "peak_rss_mb": peak_rss_mb(),
        "map_tiles": len(tiles),
        "map_resets": mapper.counters["map_resets"],
        "state": {state: states[state] for state in STATES},
        "fixes": {
            name.removeprefix("fixes_"): count
            for name, count in sorted(mapper.counters.items())
            if name.startswith("fixes_")
        },
        "geo_reference": None if geo is None else geo.as_dict(),
    }
    summary |= switches.as_dict()
    session_graph = None
    if mapping.mode == "localization":
        graph, session_graph = None, graph  # the map stays the one it was
    if (changes := mapper.map_changes) is not None:
        summary["map_changes"] = changes.as_dict()
    return Replay(outputs, poses, tiles, g2o, summary, session.notes, geo, graph, changes, session_graph)


def _replay_from_raw(
    paths: Sequence[Path], options: ReplayOptions, progress: Progress, watch: Watch
) -> Replay:
    with TemporaryDirectory(prefix="corridor-") as folder:
        made = Path(folder) / paths[0].name
        remade = remake_frames(paths, options.config, made, lambda share: progress(share, REMAKING))
        done = replay([made], replace(options, from_raw=False), progress, watch)
    done.summary[FROM_RAW] = {name: asdict(counts) for name, counts in remade.items()}
    return done


def write_replay(done: Replay, out: Path) -> None:
    """trajectory.tum, trajectory_live.tum, map.pgm + map.yaml, map.png, graph.g2o, geo.json, summary.json,
    and map/, the map as it is stored: `--map` and map.load begin in it. Where it was localised in a stored
    map, changes.csv: what has changed since.

    There is no graph.g2o where the profile has no graph. Where fixes do not anchor the map there is no
    geo.json, and none of an earlier replay stays; where they do, map.png has a world file beside it, as far
    as UTM reaches. Raises StorageError.

    map.png is for people: cropped, with the way, the origin and a scale bar.
    Poses are written as a subscriber or an export of the live session has them, to the last digit.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        stamps = [output.stamp_ns for output in done.outputs]
        live = [pose_on_wire(output.pose_map_base) for output in done.outputs]
        write_tum(out / "trajectory_live.tum", zip(stamps, live, strict=True))
        write_tum(out / "trajectory.tum", zip(stamps, map(pose_on_wire, done.poses_map_base), strict=True))
        if done.g2o:
            (out / "graph.g2o").write_text(done.g2o, encoding="ascii")
        picture = picture_of_tiles(done.tiles)
        write_ros_map(out / "map.pgm", out / "map.yaml", picture)
        shown = annotated(picture, done.poses_map_base)
        write_png(out / "map.png", shown, PALETTE)
        for name in (GEO_FILE, "map.pgw", "map.prj"):
            (out / name).unlink(missing_ok=True)
        if done.geo is not None:
            write_geo(out / GEO_FILE, done.geo)
            if abs(done.geo.origin.latitude_deg) < UTM_MOST_LATITUDE_DEG:
                write_world_file(out / "map.png", shown, done.geo)
        write_changes(out / CHANGES_FILE, done.changes)
        _store_map(done, out / "map")
        (out / "summary.json").write_text(json.dumps(done.summary, indent=1) + "\n", encoding="ascii")
    except OSError as error:
        raise StorageError(f"cannot write to {out}: {error}") from error


def _store_map(done: Replay, folder: Path) -> None:
    """In the place of one of an earlier replay; none where a session could not go on in it."""
    if is_map_folder(folder):
        shutil.rmtree(folder)
    if done.graph is not None and len(done.graph):
        about = {"profile": str(done.summary["profile"])}
        save_map(folder, done.tiles, done.outputs[-1].stamp_ns, about, done.geo, done.graph)


def _request(mapper: MappingSession, request: GraphRequest) -> None:
    try:
        mapper.request(request.name, request.payload)
    except GraphRequestError as error:
        log.info("%s", error)


def _setup(
    session: Session, options: ReplayOptions
) -> tuple[MappingConfig, Mapping[str, SE2], Sequence[str], bool]:
    """How to map, where the lasers sit, which of them are mapped, and whether all is as it was live.

    By --config, else by the recording's own config, else defaults.
    """
    config: ReplayConfig | None = None
    recorded: ReplayConfig | None = None
    if (text := session.metadata.get("config", {}).get("yaml")) is not None:
        try:
            config = recorded = parse_replay_config(text, "recorded config")
        except ConfigError as error:
            if options.config is None:
                raise ConfigError(
                    [*error.faults, "the recorded config is of another version; give one by --config"]
                ) from error
    if options.config is not None:
        config = load_replay_config(options.config)
    mapping = config.mapping if config is not None else mapping_config()
    if options.profile is not None and options.profile != mapping.profile:
        try:
            mapping = with_profile(options.profile, mapping)
        except ValueError as error:
            raise ConfigError([f"--profile: {error}"]) from error
    configured = mountings(config.sensors) if config is not None else {}
    poses = {name: configured.get(name, pose) for name, pose in session.mountings.items()}
    poses |= session.antennas | {name: pose for name, pose in configured.items() if name not in poses}
    as_live = (
        recorded is not None
        and mapping == recorded.mapping
        and (recorded.begin_in is None) == (options.map is None)
        and FROM_RAW not in session.metadata
    )
    if options.localize:
        mapping = mapping.model_copy(update={"mode": "localization"})
    if mapping.mode == "localization" and options.map is None:
        raise ConfigError(["mapping.mode is localization: give the map to localise in by --map"])
    return mapping, poses, _lasers(session, config), as_live


def _lasers(session: Session, config: ReplayConfig | None) -> Sequence[str]:
    """Whose scans are mapped: as the config says. Where that knows none of them, those of every laser whose
    mounting is known; where none is, of the one with most scans.
    """
    scans = session.scan_counts
    if config is None or (config.mapping.lasers is None and not scans.keys() & laser_names(config.sensors)):
        mounted = sorted(scans.keys() - session.unmounted)
        return mounted or [min(scans, key=lambda name: (-scans[name], name))]
    wanted = mapped_lasers(config)
    lasers = [name for name in wanted if name in scans]
    if not lasers or (config.mapping.lasers is not None and len(lasers) < len(wanted)):
        raise InputError(
            f"{session.recording.paths[0]}: the config maps {' and '.join(wanted) or 'no laser'}, but the "
            f"scans here are of {' and '.join(scans)}; name some of these in mapping.lasers of a config and "
            "give it by --config"
        )
    return lasers


def _replay_to(
    session: Sequence[Path],
    options: ReplayOptions,
    out: Path,
    progress: Progress = lambda share, phase: None,
    watch: Watch | None = None,
) -> dict[str, Any]:
    done = replay(session, options, progress, watch)
    write_replay(done, out)
    return done.summary


def _part_of(progress: Progress, part: int, parts: int) -> Progress:
    """Mapping counts over all sessions; the other phases come anew with each."""

    def tell(share: float | None, phase: str) -> None:
        progress((part + share) / parts if share is not None and phase == MAPPING else share, phase)

    return tell


def _dropped(session: Session, mapper: MappingSession) -> int:
    """Scans of the mapped lasers that were read and not mapped: out of order, or without anything to map."""
    late = sum(count for name, count in mapper.counters.items() if name.startswith("scans_dropped"))
    scans = [
        topic.name
        for topic in session.recording.topics
        if topic.type == LASER_SCAN and mapper.lasers & set(session.devices.get(topic.name, {}).values())
    ]
    return late + sum(session.counters[f"{topic} unusable"] for topic in scans)


def _in_words(devices: Mapping[str, Mapping[str, Any]]) -> str:
    """What came in a shared topic: "300 of front, read as scan; 299 of rear, refused"."""
    return "; ".join(
        f"{device['messages']} of {frame or 'an empty one'}, "
        + ("refused" if device["sensor"] is None else f"read as {device['sensor']}")
        for frame, device in devices.items()
    )
