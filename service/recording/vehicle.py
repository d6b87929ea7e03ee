"""The devices of one vehicle in a recording: those chosen for the mapper, and their mountings."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

from drivers.antenna import antenna_of
from drivers.frames import LaserScan
from service.conversion import CloudConverter, Echo, scan_of_echoes
from service.encoding import (
    IMU,
    MULTI_ECHO_SCAN,
    NAV_SAT_FIX,
    ODOMETRY,
    POINT_CLOUD,
    TF,
    decode_pose,
    turned_over,
)
from service.errors import InputError, UsageError
from service.geometry.se2 import SE2
from service.recording.choice import Choice
from service.recording.mcap_reader import Readable, Topic
from service.recording.mountings import (
    Mounting,
    MountingError,
    StaticTree,
    in_words,
    planar_mounting,
    refuse_far,
)
from service.recording.sources import (
    LASER_TYPES,
    SCAN_TYPES,
    Source,
    all_of_ours,
    choose_one,
    choose_scans,
    name_sensors,
    named_topic,
    sources_of,
)
from service.recording.tf_odometry import (
    BASE_FRAMES,
    Edges,
    WithOdometryOfTf,
    edges_of,
    is_base,
    odometry_edge,
    robot_of,
)

Converter = Callable[[bytes, str, int], LaserScan | None]  # of a payload, a sensor's name and a log time, ns


@dataclass(slots=True)
class Devices:
    """The chosen devices of a recording; fields as of mcap_source.Session."""

    recording: Readable  # with the odometry of its /tf, where it has no other
    sensors: dict[Source, str]
    notes: list[str]
    warnings: list[str]
    mountings: dict[str, SE2] = field(default_factory=dict)
    upside_down: set[str] = field(default_factory=set)
    unmounted: dict[str, str] = field(default_factory=dict)
    antennas: dict[str, SE2] = field(default_factory=dict)
    converters: dict[str, Converter] = field(default_factory=dict)


class Vehicle:
    """The devices of one vehicle in a recording, and their mountings."""

    def __init__(self, recording: Readable, choice: Choice, notes: list[str]) -> None:
        self._recording = recording
        self._choice = choice
        self._notes = notes
        self._warnings: list[str] = []
        self._tree = StaticTree(recording)
        self._sources: dict[str, list[Source]] = {}
        self._edges: Edges | None = None  # of /tf, once they were read

    def all_of(self, ours: Sequence[Topic]) -> list[Source]:
        """All devices of our own session."""
        self._sources = {topic.name: sources_of(self._recording, topic) for topic in ours}
        return all_of_ours(self._sources)

    def choose(self, readable: Sequence[Topic]) -> list[Source]:
        """Scans as they are named, else every laser; of odometries, IMUs and receivers one of the same base.

        Raises InputError where the lasers are of several vehicles, UsageError.
        """
        recording, choice, notes = self._recording, self._choice, self._notes
        named = self._named_scans()
        lasers = named or [topic for topic in readable if topic.type in LASER_TYPES]
        lasers = lasers or [topic for topic in readable if topic.type == POINT_CLOUD]
        others = [topic for topic in readable if topic.type in (ODOMETRY, IMU, NAV_SAT_FIX)]
        self._sources = {topic.name: sources_of(recording, topic) for topic in (*lasers, *others)}
        if named:
            scans = [source for topic in named for source in self._sources[topic.name]]
        else:
            scans = choose_scans(self._sources, notes)
        scans, robot = self._of_one_base(scans)
        rivals = {_namespace(topic.name) for topic in lasers} - {_namespace(s.topic.name) for s in scans}

        def is_own(source: Source) -> bool:
            frames = (
                {moved_frame(source)} if source.topic.type == ODOMETRY else self._tree.chain(source.frame)
            )
            robots = {robot_of(frame) for frame in frames if is_base(frame)}
            is_rival = (_namespace(source.topic.name) or None) in rivals
            return not is_rival and (robot is None or not robots or robot in robots)

        odometry = self._odometry(is_own, robot, scans)
        if choice.imu_topic:
            imus = sources_of(recording, named_topic(recording, "--imu-topic", choice.imu_topic, (IMU,)))[:1]
            self._sources[imus[0].topic.name] = imus
        else:
            imus = choose_one(self._sources, IMU, is_own, notes)
        return [*scans, *odometry, *choose_one(self._sources, NAV_SAT_FIX, is_own, notes), *imus]

    def _named_scans(self) -> list[Topic]:
        return [
            named_topic(self._recording, "--scan-topic", name, SCAN_TYPES)
            for name in dict.fromkeys(self._choice.scan_topics)
        ]

    def _of_one_base(self, scans: list[Source]) -> tuple[list[Source], str | None]:
        """The lasers of one vehicle, and the prefix of its frames, None where it is unknown."""
        base = self._choice.base_frame
        bases = {source: self._bases_above(source) for source in scans}
        if base is not None:
            strange = [s for s in scans if bases[s] and base not in self._tree.chain(s.frame)]
            known = self._frames()
            if len(strange) == len(scans) or base not in known:
                raise UsageError(
                    f"--base-frame {base}: no chosen laser of {self._recording.paths[0]} sits on it; "
                    f"frames in it are {', '.join(sorted(known)) or 'not named'}"
                )
            for source in strange:
                self._notes.append(f"passed over {source}: it sits on {bases[source][0]}, not on {base}")
            return [s for s in scans if s not in strange], robot_of(base)
        robots = {robot_of(above[0]): above[0] for above in bases.values() if above}
        if len(robots) > 1:
            sit = ", ".join(f"{source.topic.name} on {above[0]}" for source, above in bases.items() if above)
            raise InputError(
                f"{self._recording.paths[0]}: the lasers sit on {len(robots)} bases: {sit}; name one by "
                f"--base-frame ({' or '.join(sorted(robots.values()))}) or its lasers by --scan-topic"
            )
        return scans, next(iter(robots), None)

    def _bases_above(self, source: Source) -> list[str]:
        """Frames above a sensor that are called like a base, the likeliest first."""

        def found() -> list[str]:
            above = [frame for frame in self._tree.chain(source.frame) if is_base(frame)]
            return sorted(above[::-1], key=lambda frame: (*(frame != base for base in BASE_FRAMES),))

        return found() or (found() if self._tree.learn_repeated() else [])

    def _frames(self) -> set[str]:
        """Frames of transforms, and those that odometry moves."""
        frames = {frame for child, (parent, _) in self._tree.parents.items() for frame in (child, parent)}
        frames |= {frame for edge in self._edges_of_tf().counts for frame in edge}
        found = [source for of_topic in self._sources.values() for source in of_topic]
        return frames | {moved_frame(source) for source in found if source.topic.type == ODOMETRY} - {""}

    def _edges_of_tf(self) -> Edges:
        if self._edges is None:
            self._edges = edges_of(self._recording)
        return self._edges

    def _odometry(
        self, is_own: Callable[[Source], bool], robot: str | None, scans: Sequence[Source]
    ) -> list[Source]:
        """The odometry that is named, else that of the vehicle's own base, else that of /tf."""
        choice, sources = self._choice, self._sources
        if choice.odom_topic is not None:
            topic = named_topic(self._recording, "--odom-topic", choice.odom_topic, (ODOMETRY, TF))
            if topic.type == ODOMETRY:
                sources[topic.name] = sources_of(self._recording, topic)[:1]
                return sources[topic.name]
        elif choice.odom_frame is None:
            if found := choose_one(sources, ODOMETRY, is_own, self._notes):
                return found
        else:
            named = {n: [s for s in of if s.frame == choice.odom_frame] for n, of in sources.items()}
            if found := choose_one({n: of for n, of in named.items() if of}, ODOMETRY, is_own, self._notes):
                return found
        above = {frame for source in scans for frame in self._tree.chain(source.frame)}
        edges = self._edges_of_tf()
        fitting = odometry_edge(edges, choice, above, robot)
        if len(fitting) > 1:
            raise InputError(
                f"{self._recording.paths[0]}: its odometry is one of {len(fitting)} edges of /tf: "
                f"{edges.in_words(fitting)}; name it by --odom-frame and --base-frame"
            )
        if fitting:
            self._recording = WithOdometryOfTf(self._recording, fitting[0], edges.counts[fitting[0]])
            topic = self._recording.topics[-1]
            sources[topic.name] = sources_of(self._recording, topic)
            self._notes.append(f"odometry is {edges.in_words(fitting)} of /tf")
            return sources[topic.name]
        if choice.odom_topic is not None or choice.odom_frame is not None:
            option = (
                f"--odom-frame {choice.odom_frame}" if choice.odom_frame else f"--odom-topic {topic.name}"
            )
            frames = {s.frame for of in sources.values() for s in of if s.topic.type == ODOMETRY}
            raise UsageError(
                f"{option}: no odometry of {self._recording.paths[0]}; header.frame_id of its Odometry: "
                f"{', '.join(sorted(frames)) or 'there is none'}; edges of /tf: "
                f"{edges.in_words(edges.counts) or 'there are none'}"
            )
        if edges.changed:
            moving = edges.in_words(sorted(edges.changed))
            self._warnings.append(
                f"no odometry is used: none of the edges of /tf is known as one ({moving}); "
                "where one is, name it by --odom-frame and --base-frame"
            )
        return []

    def devices(self, chosen: Sequence[Source]) -> Devices:
        """The chosen devices with their mountings. Raises InputError where no laser is left to be mapped."""
        notes, tree = self._notes, self._tree
        found = Devices(self._recording, name_sensors(chosen, self._sources), notes, self._warnings)
        bases = self._base_frames(chosen)
        for source in chosen:
            sensor = found.sensors[source]
            if source.topic.type == ODOMETRY:
                continue
            try:
                if source.topic.type == NAV_SAT_FIX:
                    found.antennas |= _antennas(source, sensor, tree, bases, notes)
                    continue
                if source.topic.type == POINT_CLOUD:
                    mount, found.converters[sensor] = self._of_cloud(source, bases)
                else:
                    mount = _mount(source, self._sources[source.topic.name], tree, bases, notes)
            except MountingError as error:
                facts = self._warnings if self._is_named(source) else notes
                facts.append(f"passed over {source}: {error}")
                del found.sensors[source]
                continue
            if source.topic.type == MULTI_ECHO_SCAN:
                echoes = partial(_of_echoes, echo=self._choice.echo, over=mount.upside_down)
                found.converters[sensor] = echoes
            if mount.guessed and source.topic.type in SCAN_TYPES:
                found.unmounted[sensor] = mount.guessed
            elif mount.guessed:
                notes.append(mount.guessed)
            if mount.upside_down:
                found.upside_down.add(sensor)
            if source.topic.type in SCAN_TYPES:
                found.mountings[sensor] = mount.pose_base_sensor
        if not found.mountings:
            raise InputError(_nothing_to_map(self._recording, notes))
        above = {frame: None for source in found.sensors for frame in tree.chain(source.frame)}
        for frame in [frame for frame in above if frame in tree.contradicted]:
            self._warnings.append(
                f"/tf_static has two transforms of {frame}: {in_words(tree.edges[frame])}, which is used, "
                f"and later {in_words(tree.contradicted[frame])}; if the later one is right, map and poses "
                "are wrong: give the mounting in a config by --config"
            )
        return found

    def _is_named(self, source: Source) -> bool:
        names = (*self._choice.scan_topics, self._choice.imu_topic or "")
        return source.topic.name.strip("/") in {name.strip("/") for name in names}

    def _base_frames(self, chosen: Sequence[Source]) -> list[str]:
        """Base frames of the mountings: the named one, else the frame that odometry moves, else by name."""
        if self._choice.base_frame is not None:
            return [self._choice.base_frame]
        moved = [moved_frame(source) for source in chosen if source.topic.type == ODOMETRY]
        scans = [source for source in chosen if source.topic.type in SCAN_TYPES]
        above = [base for source in scans for base in self._bases_above(source)]
        return list(dict.fromkeys([*filter(None, moved), *BASE_FRAMES, *above]))

    def _of_cloud(self, source: Source, bases: Sequence[str]) -> tuple[Mounting, Converter]:
        """A 3-D cloud is turned level: its device may sit tilted as it likes. Raises MountingError."""
        above = self._tree.chain(source.frame)
        base = next((base for base in bases if base in above), None)
        if base is None and self._tree.learn_repeated():
            return self._of_cloud(source, bases)
        matrix = above[base] if base is not None else None
        if base is not None and matrix is not None:
            refuse_far(matrix, base)
        converter = CloudConverter(self._choice, matrix)
        converter.scan(source.head.payload, "", 0)  # judges whether the laser is planar
        if converter.is_planar:
            planar_mounting(self._tree, bases, source.frame)  # refuses what is tilted
        else:
            where = "of its own height" if matrix is None else f"above {base}"
            self._notes.append(
                f"{source}: 3-D points from {converter.z_min_m:g} to {converter.z_max_m:g} m {where} count"
            )
        if matrix is None:
            return Mounting(SE2(), upside_down=False, guessed=_guessed(source, bases)), converter.scan
        yaw_rad = math.atan2(matrix[1, 0], matrix[0, 0])
        return Mounting(SE2(float(matrix[0, 3]), float(matrix[1, 3]), yaw_rad), False), converter.scan


def moved_frame(odometry: Source) -> str:
    """child_frame_id of an Odometry."""
    return decode_pose(odometry.head.payload).child.lstrip("/")


def _of_echoes(payload: bytes, sensor: str, log_ns: int, echo: Echo, over: bool) -> LaserScan | None:
    scan = scan_of_echoes(payload, sensor, log_ns, echo)
    return turned_over(scan) if over and scan is not None else scan


def _namespace(topic: str) -> str:
    """ "robot1" of "/robot1/base/scan"; "" of "/scan"."""
    first, _, rest = topic.strip("/").partition("/")
    return first if rest else ""


def _mount(
    source: Source, of_topic: Sequence[Source], tree: StaticTree, bases: Sequence[str], notes: list[str]
) -> Mounting:
    """Mounting of a device. None in a topic counts as mounted at the origin beside one with a mounting.

    Raises MountingError.
    """
    mount = planar_mounting(tree, bases, source.frame)
    if mount is None:
        where = _no_chain(source, bases)
        mounted = [other for other in of_topic if not tree.chain(other.frame).keys().isdisjoint(bases)]
        if mounted or source is not of_topic[0]:
            raise MountingError(f"{where}, and in this topic it is not the only one")
        return Mounting(SE2(), upside_down=False, guessed=_guessed(source, bases))
    if mount.upside_down:
        notes.append(f"{source}: mounted upside down; what it says is turned back")
    return mount


def _no_chain(source: Source, bases: Sequence[str]) -> str:
    return f"/tf_static does not lead from {source.frame or 'its empty frame_id'} to {' or '.join(bases)}"


def _guessed(source: Source, bases: Sequence[str]) -> str:
    return f"{source}: {_no_chain(source, bases)}; taken as mounted at the base's origin, looking ahead"


def _antennas(
    source: Source, sensor: str, tree: StaticTree, bases: Sequence[str], notes: list[str]
) -> dict[str, SE2]:
    """Positions of a receiver and its antenna; an antenna may have any orientation. Raises MountingError."""
    names = {antenna_of(sensor): antenna_of(source.frame), sensor: source.frame}
    above = {name: tree.chain(frame) for name, frame in names.items()}
    found: dict[str, SE2] = {}
    for name, frames in above.items():
        base = next((base for base in bases if base in frames and len(frames) > 1), None)
        if base is not None:
            refuse_far(frames[base], base)
            found[name] = SE2(float(frames[base][0, 3]), float(frames[base][1, 3]), 0.0)
    if not found:
        where = f"from {source.frame or 'its empty frame_id'} to {' or '.join(bases)}"
        notes.append(
            f"{source}: /tf_static does not lead {where}; its antenna is taken as above the base's origin"
        )
    return found


def _nothing_to_map(recording: Readable, notes: Sequence[str]) -> str:
    where = ", ".join(map(str, recording.paths))
    listed = ", ".join(map(str, recording.topics)) or "nothing"
    reasons = "".join(f"; {note}" for note in notes)
    return f"{where}: no {', '.join(SCAN_TYPES)} that can be mapped; it holds {listed}{reasons}"
