"""Frames out of recordings, for the replay: our own sessions, and those of any other ROS 2 system.

In a session of ours a sensor's topics are `/<sensor>/scan`, `imu`, `odom` and `fix`. In others
they are found by type; where several fit, one is chosen, and the notes say what was passed over. Each
header.frame_id in a topic is a device of its own.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, groupby, islice
from pathlib import Path
from typing import Any

from drivers.antenna import antenna_of
from drivers.frames import Frame, LaserScan
from service.encoding import (
    BASE_FRAME,
    IMU,
    LASER_SCAN,
    MAP_FRAME,
    NAV_SAT_FIX,
    NO_COVARIANCE,
    NO_ROTATION,
    ODOMETRY,
    STRING,
    Message,
    decode_frame,
    decode_pose,
    decode_step,
    frame_id,
    odometry_fault,
    read,
)
from service.errors import InputError
from service.geometry.se2 import SE2
from service.mapper.mapping_session import Step
from service.recording.mcap_reader import Readable, Topic
from service.recording.mountings import Mounting, MountingError, StaticTree, planar_mounting
from service.recording.opening import open_recording

FRAME_TYPES = {LASER_SCAN: "scan", IMU: "imu", ODOMETRY: "odom", NAV_SAT_FIX: "fix"}
BASE_FRAMES = (BASE_FRAME, "base_footprint")
# A sweep so wide takes most of a laser's period; those of one instant are flash sensors, and narrower.
MOST_INSTANT_DEG = 200.0
INSTANT = "instant"  # scans that say so all the same
SAMPLED = 100  # messages at the beginning of a topic: what is not among them is not expected later
DERIVED = ("filter", "fused", "icp", "visual", "amcl", "slam", "merged")  # made by others from the raw topic


@dataclass(slots=True)
class Session:
    """What a recording offers to a mapper.

    devices        topic -> frame_id -> sensor name; the topics and devices whose frames come out
    scan_counts    laser -> how many of its scans the recording says it holds; where several devices share a
                   topic, by their shares at its beginning
    mountings      sensor name -> pose_base_sensor, for lasers; from /tf_static
    antennas       the same for GNSS antennas, "<sensor>/antenna" where one is told apart from its sensor
    metadata       config, calibration, clocks as written by the recorder; empty in foreign recordings
    upside_down    sensors that are mounted so; what they say is turned back
    unmounted      lasers taken as sitting at the base's origin, for nothing says where they sit -> why
    events         topics whose events may be requests to the mapping session: ours has one, others have none
    notes          what was chosen and what was passed over, one line each, for people
    counters       filled while reading: frames by topic, messages without usable content, those refused
                   because of a frame_id that is not expected, by topic what odometry_fault says and scans
                   all around that claim to be of one moment
    frame_ids      filled while reading: topic -> frame_id -> messages
    """

    recording: Readable
    devices: dict[str, dict[str, str]]
    scan_counts: dict[str, int]
    mountings: dict[str, SE2]
    notes: list[str]
    upside_down: frozenset[str]
    unmounted: Mapping[str, str] = field(default_factory=dict)
    antennas: dict[str, SE2] = field(default_factory=dict)
    events: tuple[str, ...] = ()
    counters: Counter[str] = field(default_factory=Counter)
    frame_ids: dict[str, Counter[str]] = field(default_factory=dict)

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        return self.recording.metadata

    @property
    def sensors(self) -> dict[str, str]:
        """Topic -> sensor; where several share a topic, the first."""
        return {topic: next(iter(sensors.values())) for topic, sensors in self.devices.items()}

    @property
    def shared_topics(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Topics in which more than one frame_id came -> frame_id -> its "messages", and the "sensor" as
        which they were read; None: they were refused.
        """
        return {
            topic: {
                frame: {"messages": count, "sensor": self.devices[topic].get(frame)}
                for frame, count in counts.items()
            }
            for topic, counts in self.frame_ids.items()
            if len(counts) > 1
        }

    @property
    def losses(self) -> list[str]:
        """What could not be read of the files, and not be used of the messages that were read: one line a
        file or topic, for people.
        """
        lines = list(self.recording.losses)
        for topic in self.devices:
            unusable, rotation, covariance = (
                self.counters[f"{topic} {what}"] for what in ("unusable", NO_ROTATION, NO_COVARIANCE)
            )
            read = self.counters[topic] + unusable
            if unusable:
                why = f"; the orientation of {rotation} is a quaternion of 0" if rotation else ""
                lines.append(f"{topic}: {unusable} of {read} messages cannot be used{why}")
            if covariance:
                lines.append(
                    f"{topic}: the covariance of {covariance} of {read} messages is none (not finite, or "
                    "beyond all sense) and counts as unknown; their poses are used"
                )
            if instant := self.counters[f"{topic} {INSTANT}"]:
                lines.append(
                    f"{topic}: {instant} of {read} scans are of more than {MOST_INSTANT_DEG:.0f} deg with a "
                    "time_increment of 0, so all beams count as measured at once; if this laser rotates, "
                    "turns bend its scans and the map. Does its driver set time_increment?"
                )
        return lines

    def topic_of(self, message: Message) -> str:
        """As the recording names it: in ROS with a slash ahead, by other writers perhaps without."""
        name = f"/{message.channel}"
        return name if name in self.devices or name in self.events else message.channel

    def frames(self) -> Iterator[Frame]:
        """What `steps` gives, without the requests in between."""
        return (step for step in self.steps() if not isinstance(step, Step))

    def steps(self) -> Iterator[Frame | Step]:
        """Frames and requests by rising log time, in our sessions the order in which the mapper had them.

        Where a foreign recording gives a scan and a sample one log time, the sample goes first: a scan that
        is mapped before the odometry of its own moment has to guess the last piece of its way.

        A message that is no use to a mapper is counted and left out. Raises InputError at a damaged place.
        """
        self.counters.clear()
        self.frame_ids = {topic: Counter() for topic in self.devices}
        for message in self._in_order():
            topic = self.topic_of(message)
            if topic in self.events:
                yield from self._step(message)
                continue
            try:
                device = frame_id(message.payload)
                sensor = self.devices[topic].get(device)
                self.frame_ids[topic][device] += 1
                if sensor is None:
                    self.counters[f"{topic} refused"] += 1
                    continue
                over = sensor in self.upside_down
                frame = decode_frame(message.type, message.payload, sensor, message.log_ns, over)
            except InputError:
                frame = None
            if message.type == ODOMETRY and (fault := odometry_fault(message.payload)):
                self.counters[f"{topic} {fault}"] += 1
            if frame is None or sensor is None:
                self.counters[f"{topic} unusable"] += 1
                continue
            self.counters[topic] += 1
            if isinstance(frame, LaserScan) and _is_instant(frame):
                self.counters[f"{topic} {INSTANT}"] += 1
            yield frame

    def _in_order(self) -> Iterator[Message]:
        messages = self.recording.messages([*self.devices, *self.events])
        for _, of_one_time in groupby(messages, key=lambda message: message.log_ns):
            yield from sorted(of_one_time, key=lambda message: message.type == LASER_SCAN)

    def _step(self, event: Message) -> list[Step]:
        try:
            step = decode_step(event.payload, event.log_ns)
        except InputError:
            self.counters[f"/{event.channel} unusable"] += 1
            return []
        return [] if step is None else [step]


def _is_instant(scan: LaserScan) -> bool:
    """Whether beams all around claim to be of one moment."""
    span_rad = (len(scan.range_m) - 1) * abs(scan.angle_step_rad)
    return scan.beam_interval_ns == 0 and span_rad > math.radians(MOST_INSTANT_DEG)


def open_session(paths: Sequence[Path]) -> Session:
    """Look into finished recordings. Raises InputError where there is no laser scan that can be mapped."""
    return session_of(open_recording(paths))


def session_of(recording: Readable) -> Session:
    """As open_session, of a recording that is already open."""
    notes: list[str] = []
    readable = [topic for topic in recording.topics if topic.type in FRAME_TYPES and topic.count]
    for topic in [t for t in readable if t.encoding != "cdr"]:
        notes.append(f"passed over {topic}: encoded as {topic.encoding!r}; only ROS 2's cdr is read")
    readable = [topic for topic in readable if topic.encoding == "cdr"]
    ours = [topic for topic in readable if _is_ours(topic)] if _is_our_session(recording) else []
    sources = {topic.name: _sources(recording, topic) for topic in ours or readable}
    chosen = _all_of_ours(sources) if ours else _choose(sources, notes)
    sensors = _name_sensors(chosen, sources)
    tree = StaticTree(recording)
    moved = [decode_pose(s.head.payload).child.lstrip("/") for s in chosen if s.topic.type == ODOMETRY]
    bases = tuple(dict.fromkeys([*filter(None, moved), *BASE_FRAMES]))  # what the odometry moves is the base
    mounts: dict[str, Mounting] = {}
    upside_down: set[str] = set()
    unmounted: dict[str, str] = {}
    antennas: dict[str, SE2] = {}
    for source in chosen:
        if source.topic.type == NAV_SAT_FIX:
            antennas |= _antennas(source, sensors[source], tree, bases, notes)
            continue
        if source.topic.type == ODOMETRY:
            continue
        try:
            mount = _mount(source, sources[source.topic.name], tree, bases, notes)
        except MountingError as error:
            notes.append(f"passed over {source}: {error}")
            del sensors[source]
            continue
        if mount.guessed and source.topic.type == LASER_SCAN:
            unmounted[sensors[source]] = mount.guessed
        elif mount.guessed:
            notes.append(mount.guessed)
        if mount.upside_down:
            upside_down.add(sensors[source])
        if source.topic.type == LASER_SCAN:
            mounts[sensors[source]] = mount
    if not mounts:
        raise InputError(_nothing_to_map(recording, notes))
    devices: dict[str, dict[str, str]] = {}
    for source, sensor in sensors.items():
        devices.setdefault(source.topic.name, {})[source.frame] = sensor
    return Session(
        recording=recording,
        devices=devices,
        scan_counts={
            sensor: round(source.share * source.topic.count)
            for source, sensor in sensors.items()
            if sensor in mounts and source.topic.type == LASER_SCAN
        },
        mountings={sensor: mount.pose_base_sensor for sensor, mount in mounts.items()},
        notes=[f"reading {', '.join(map(str, sensors))}", *notes],
        upside_down=frozenset(upside_down),
        unmounted=unmounted,
        antennas=antennas,
        events=tuple(t.name for t in recording.topics if ours and (t.name, t.type) == ("/events", STRING)),
    )


def _is_our_session(recording: Readable) -> bool:
    """By who wrote it; or, where another program rewrote it, by what only we write."""
    by_us = recording.library.startswith("corridor ") or any(t.name == "/pose" for t in recording.topics)
    return by_us and any(_is_ours(t) and t.type == LASER_SCAN for t in recording.topics)


def _is_ours(topic: Topic) -> bool:
    parts = topic.name.split("/")
    return len(parts) == 3 and parts[0] == "" and FRAME_TYPES.get(topic.type) == parts[2]


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """One device: what comes in a topic under one header.frame_id."""

    topic: Topic
    frame: str
    head: Message  # the first that can be read
    share: float  # of the messages at the beginning of the topic; 1: it is alone there

    def __str__(self) -> str:
        return str(self.topic) if self.share == 1.0 else f"frame_id {self.frame!r} in {self.topic}"


def _sources(recording: Readable, topic: Topic) -> list[_Source]:
    """The devices at the beginning of a topic, the one that sends most first."""
    heads: dict[str, Message] = {}
    counts: Counter[str] = Counter()
    for message in islice(recording.messages([topic.name]), SAMPLED):
        try:
            read(message.type, message.payload)
            frame = frame_id(message.payload)
        except InputError:
            continue
        heads.setdefault(frame, message)
        counts[frame] += 1
    if not counts:
        raise InputError(
            f"{recording.paths[0]}: the first messages of {topic} cannot be read as what they claim"
        )
    return [_Source(topic, f, heads[f], count / counts.total()) for f, count in counts.most_common()]


def _name_sensors(chosen: Sequence[_Source], sources: Mapping[str, Sequence[_Source]]) -> dict[_Source, str]:
    """ "/front/scan" is "front", "/scan" is "scan", "/robot1/base_scan" is "robot1_base_scan".

    Where devices share a topic, the first is called so, and the others "front_<frame_id>".
    """
    names: dict[str, str] = {}
    topics = list(dict.fromkeys(source.topic for source in chosen))
    for topic in topics:
        whole = topic.name.strip("/").replace("/", "_")
        name = whole.removesuffix(f"_{FRAME_TYPES[topic.type]}") or whole
        taken = {names[t.name] for t in topics if t.name in names and t.type == topic.type}
        names[topic.name] = whole if name in taken else name
    return {
        source: names[source.topic.name]
        if source is sources[source.topic.name][0]
        else f"{names[source.topic.name]}_{source.frame.replace('/', '_')}"
        for source in chosen
    }


def _all_of_ours(sources: Mapping[str, Sequence[_Source]]) -> list[_Source]:
    return [
        source
        for of_topic in sources.values()
        for source in of_topic
        if source is of_topic[0] or source.topic.type == LASER_SCAN
    ]


def _choose(sources: Mapping[str, Sequence[_Source]], notes: list[str]) -> list[_Source]:
    """Every laser once; of odometries, IMUs and receivers one, and of those in one topic the fullest."""
    chosen = []
    by_frame: dict[str, list[_Source]] = {}
    for source in chain.from_iterable(sources.values()):
        if source.topic.type == LASER_SCAN:
            by_frame.setdefault(source.frame, []).append(source)
    for sensor_frame, of_laser in by_frame.items():
        chosen += _first(of_laser, f"another of the laser at {sensor_frame}", ("/scan",), notes)
    firsts = [of_topic[0] for of_topic in sources.values()]
    odometries = [source for source in firsts if source.topic.type == ODOMETRY]
    for source in [s for s in odometries if s.frame == MAP_FRAME]:
        notes.append(f"passed over {source}: poses in the map are a result, not odometry")
        odometries.remove(source)
    chosen += _first(odometries, "one odometry is used", ("/odom", "/odometry"), notes)
    receivers = [source for source in firsts if source.topic.type == NAV_SAT_FIX]
    chosen += _first(receivers, "one GNSS receiver is used", ("/fix", "/gps/fix"), notes)
    imus = [source for source in firsts if source.topic.type == IMU]
    chosen += _first(imus, "one IMU is used", ("/imu/data", "/imu"), notes)
    return chosen


def _first(
    sources: Sequence[_Source], reason: str, preferred: Sequence[str], notes: list[str]
) -> list[_Source]:
    """From the raw topic: not a shared one, by its usual name, else not a derived one, else the fullest."""

    def rank(source: _Source) -> tuple[bool, bool, bool, int, str]:
        name = source.topic.name
        derived = any(word in name for word in DERIVED)
        return source.share < 1.0, name not in preferred, derived, -source.topic.count, name

    best, *others = sorted(sources, key=rank) if sources else (None,)
    notes += [f"passed over {source}: {reason}, {best}" for source in others]
    return [best] if best is not None else []


def _mount(
    source: _Source,
    of_topic: Sequence[_Source],
    tree: StaticTree,
    bases: Sequence[str],
    notes: list[str],
) -> Mounting:
    """Of several devices in one topic none is taken as mounted at the origin beside one that is mounted.

    Raises MountingError.
    """
    mount = planar_mounting(tree, bases, source.frame)
    if mount is None:
        where = (
            f"/tf_static does not lead from {source.frame or 'its empty frame_id'} to {' or '.join(bases)}"
        )
        mounted = [other for other in of_topic if not tree.chain(other.frame).keys().isdisjoint(bases)]
        if mounted or source is not of_topic[0]:
            raise MountingError(f"{where}, and in this topic it is not the only one")
        guessed = f"{source}: {where}; taken as mounted at the base's origin, looking ahead"
        return Mounting(SE2(), upside_down=False, guessed=guessed)
    if mount.upside_down:
        notes.append(f"{source}: mounted upside down; what it says is turned back")
    return mount


def _antennas(
    source: _Source, sensor: str, tree: StaticTree, bases: Sequence[str], notes: list[str]
) -> dict[str, SE2]:
    """Where a receiver and its antenna sit; an antenna may be turned and tilted as it likes."""
    names = {antenna_of(sensor): antenna_of(source.frame), sensor: source.frame}
    above = {name: tree.chain(frame) for name, frame in names.items()}
    found: dict[str, SE2] = {}
    for name, frames in above.items():
        base = next((base for base in bases if base in frames and len(frames) > 1), None)
        if base is not None:
            found[name] = SE2(float(frames[base][0, 3]), float(frames[base][1, 3]), 0.0)
    if not found:
        where = f"from {source.frame or 'its empty frame_id'} to {' or '.join(bases)}"
        notes.append(
            f"{source}: /tf_static does not lead {where}; its antenna is taken as above the base's origin"
        )
    return found


def _nothing_to_map(recording: Readable, notes: Sequence[str]) -> str:
    where = ", ".join(map(str, recording.paths))
    held = ", ".join(map(str, recording.topics)) or "nothing"
    reasons = "".join(f"; {note}" for note in notes)
    return f"{where}: no {LASER_SCAN} that can be mapped; it holds {held}{reasons}"
