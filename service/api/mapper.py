"""A mapper inside of another program: the one of the service and of replays, fed frame by frame."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.frames import Frame, LaserScan
from service.api.configs import config_of, load_kernels, mountings_of, stored_folder
from service.api.poses import Pose, pose_of
from service.api.recordings import AnyPath, Recording
from service.config import mapped_lasers
from service.config import mountings as configured_mountings
from service.errors import ConfigError, InputError, UsageError
from service.geometry.se2 import SE2
from service.mapper.components import FinishedGraph
from service.mapper.corrections import corrected
from service.mapper.mapping_session import MappingSession
from service.mapper.profiles import MappingConfig, build_mapper
from service.mapper.saved_graph import SavedGraph
from service.mapper.timed import note_mapped
from service.mapstore.begin_in import begin_in
from service.mapstore.files import save_map
from service.mapstore.patch_files import PatchFiles
from service.mapstore.tiles import TileStore
from service.offline.replay.setup import ReplayOptions, set_up
from service.offline.score.trajectory import Trajectory
from service.outputs import Grid, MapperOutput
from service.timing import Timing

log = logging.getLogger(__name__)

DEFAULT_LASER = "laser"  # at the base's origin, where no laser is named


class Mapper:
    """Frames in, poses and a map out: same frames, same poses, bit for bit, as in `corridor replay`.

    config      a YAML file, or what would stand in one ({"mapping": {"profile": ...}}), of which `sensors`
                and `mapping` count; a Recording: as a replay maps it; None: the defaults. `upside_down` of a
                mounting is not applied: `read` turns such scans, for own ones see `scan`
    mountings   laser -> (x m, y m, yaw rad) in the frame of the base, besides those of the config. Where
                neither names a laser, there is one, "laser", at the base's origin
    map         folder of a stored map to begin in; None: that of the config, else a new map
    version     of that map; None: the newest, or that in which the Recording began
    localize    only localise in it: it stays as it is

    Raises ConfigError, InputError where the map cannot be read, and UsageError.
    """

    def __init__(
        self,
        config: AnyPath | Mapping[str, Any] | Recording | None = None,
        mountings: Mapping[str, npt.ArrayLike] | None = None,
        *,
        map: AnyPath | None = None,
        version: int | None = None,
        localize: bool = False,
    ) -> None:
        folder = stored_folder(map, version)
        given = mountings_of(mountings or {})
        if isinstance(config, Recording):
            options = ReplayOptions(map=folder, version=version, localize=localize, choice=config.choice)
            setup = set_up(config.session, options)
            mapping, poses = setup.mapping, setup.poses_base_sensor
            lasers = (*setup.lasers, *(given.keys() & config.lasers))
            sensors, version = config.lasers, setup.map_version
        else:
            read = config_of({} if config is None else config)
            mapping, poses = read.mapping, configured_mountings(read.sensors)
            lasers = (*mapped_lasers(read), *(given.keys() - read.sensors.keys())) or (DEFAULT_LASER,)
            sensors = (*read.sensors, *lasers)
            folder = read.begin_in if folder is None else folder
        if localize:
            mapping = mapping.model_copy(update={"mode": "localization"})
        if mapping.mode == "localization" and folder is None:
            raise ConfigError(["localisation is in a stored map; name its folder by map"])
        self._mapping: MappingConfig = mapping
        self._sensors = frozenset((*sensors, *given))
        begin = None if folder is None else begin_in(folder, mapping, version)
        load_kernels()
        poses = {**dict.fromkeys(lasers, SE2()), **poses, **given}
        self._session = MappingSession(
            lambda: build_mapper(mapping, poses, new_patch_store=PatchFiles, begin_in=begin), lasers
        )
        self._timing = Timing(lasers, self._session.counters)
        self._outputs: list[MapperOutput] = []
        self._tiles = TileStore()
        self._finished: FinishedGraph | None = None
        self._has_scan = False

    @property
    def counters(self) -> Mapping[str, int]:
        """Scans mapped, and what was dropped, by reason: scans, scans_dropped_late, samples_dropped_late"""
        return self._session.counters.copy()  # 0 for what has not come about

    @property
    def warnings(self) -> Sequence[str]:
        """What is odd about the stamps of the frames so far, a sentence each."""
        return tuple(self._timing.warnings)

    def process(self, frame: Frame) -> Pose | None:
        """Take the next frame in the order of arrival; the pose of the newest scan that was mapped with it.

        None for other frames, for a scan that waits for a second of doubtful stamps to be judged, for one of
        a laser that is not mapped, and for one that is dropped, which `counters` count.

        Raises InputError for a scan of an unknown laser, UsageError for what is no frame, and when the
        mapping has been finished.
        """
        if self._finished is not None:
            raise UsageError("the mapping is finished; map on in a Mapper that begins in the saved map")
        self._refuse_unknown(frame)
        self._has_scan |= isinstance(frame, LaserScan)
        newest = None
        for timed, _ in self._timing.take(frame):
            newest = self._map(timed) or newest
        return None if newest is None else pose_of(newest)

    def map(self) -> Grid | None:
        """The map by now; None: nothing is mapped yet. Raises StorageError beyond 410 m square at 5 cm."""
        self._tiles.update(self._session.changed_tiles())
        return self._tiles.grid()

    def trajectory(self) -> Trajectory:
        """The base in the map at every scan mapped: as published, and once it is finished as corrected by all
        that is known then.
        """
        poses = corrected(self._outputs, [] if self._finished is None else self._finished.corrections)
        return trajectory_of(self._outputs, poses)

    def finish(self) -> None:
        """Take no more frames: close the last loops and correct map and trajectory by them."""
        if self._finished is None:
            for timed, _ in self._timing.finish():
                self._map(timed)
            self._finished = self._session.finish()
            self._session.close()

    def save(self, folder: AnyPath) -> int:
        """Finish, and store the map as the next version in a folder; its number, from 1.

        `Map.load`, `corridor replay --map` and `map.load` of a config read the folder; nav2 reads map.yaml
        and map.pgm in it. Raises InputError where nothing was mapped, and before the first scan without
        finishing; UsageError in localisation, which changes no map; StorageError.
        """
        if self._mapping.mode == "localization":
            raise UsageError("this mapper localises only; its map is stored already")
        if self._has_scan:
            self.finish()
        if self._finished is None:
            raise self._nothing_for(folder)
        saved = self._finished.update.saved
        number = save_map(
            Path(folder),
            self._session.tiles(),
            self._outputs[-1].stamp_ns if self._outputs else 0,
            {"profile": self._mapping.profile},
            self._session.geo_reference,
            saved if isinstance(saved, SavedGraph) else None,
        )
        if number is None:
            raise self._nothing_for(folder)
        return number

    def _nothing_for(self, folder: AnyPath) -> InputError:
        return InputError(f"{folder}: nothing was mapped ({dict(self.counters)})")

    def _refuse_unknown(self, frame: Frame) -> None:
        if not isinstance(frame, Frame):
            raise UsageError(
                f"a {type(frame).__name__} is no frame; corridor.scan, odometry, imu and fix make one"
            )
        if isinstance(frame, LaserScan) and frame.sensor not in self._sensors:
            raise InputError(
                f"a scan of {frame.sensor!r}, where the mapper knows {', '.join(sorted(self._sensors))}; "
                "give its mounting by mountings, or in the config"
            )

    def _map(self, frame: Frame) -> MapperOutput | None:
        output = self._session.process(frame)
        note_mapped(self._timing, self._session, frame, output)
        if output is not None:
            self._outputs.append(output)
        return output


def locate(scan: LaserScan, mapper: Mapper) -> Pose | None:
    """Where a scan was taken, in the stored map that a fresh mapper localises in; None: that is not known.

    With the scan the map is searched; the same scan again, a period later, has the place that was found.
    """
    mapper._refuse_unknown(scan)
    session = mapper._session
    later_ns = max(scan.scan_period_ns, 20_000_000)
    session.process(scan)
    while session.work_ready:
        session.apply_result()
    output = session.process(
        replace(scan, stamp_ns=scan.stamp_ns + later_ns, arrived_ns=scan.arrived_ns + later_ns)
    )
    session.close()
    if output is None or output.state == "lost":
        log.info("%s", "the scan cannot be mapped" if output is None else output.reason)
        return None
    return replace(pose_of(output), stamp_ns=scan.stamp_ns)


def trajectory_of(outputs: Sequence[MapperOutput], poses: Sequence[SE2]) -> Trajectory:
    rows = np.array([(pose.x_m, pose.y_m, pose.theta_rad) for pose in poses]).reshape(-1, 3)
    return Trajectory(np.array([output.stamp_ns for output in outputs], np.int64), rows)
