"""Frames out of recordings, for the replay: our own sessions, and those of any other ROS 2 system.

In a session of ours a sensor's topics are `/<sensor>/scan`, `/<sensor>/imu` and `/<sensor>/odom`. In others
they are found by type; where several fit, one is chosen, and the notes say what was passed over.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, islice
from pathlib import Path

from drivers.frames import Frame, LaserScan
from service.encoding import (
    BASE_FRAME,
    IMU,
    LASER_SCAN,
    MAP_FRAME,
    ODOMETRY,
    STRING,
    Message,
    decode_control,
    decode_frame,
    decode_pose,
    frame_id,
)
from service.errors import InputError
from service.geometry.se2 import SE2
from service.mapper.steering import Step
from service.recording.mcap_reader import Recording, Topic
from service.recording.mountings import Mounting, StaticTree, TiltedError, mounting

FRAME_TYPES = {LASER_SCAN: "scan", IMU: "imu", ODOMETRY: "odom"}
BASE_FRAMES = (BASE_FRAME, "base_footprint")
MOST_BROKEN = 100  # messages at the beginning of a topic
DERIVED = ("filter", "fused", "icp", "visual", "amcl", "slam", "merged")  # made by others from the raw topic


@dataclass(slots=True)
class Session:
    """What a recording offers to a mapper.

    sensors        topic -> sensor name; the topics whose frames come out
    mountings      sensor name -> pose_base_sensor, for lasers; from /tf_static
    metadata       config, calibration, clocks as written by the recorder; empty in foreign recordings
    events         topics whose events may steer the mapper: ours has one, others have none
    notes          what was chosen and what was passed over, one line each, for people
    counters       filled while reading: frames by topic, and messages without usable content
    """

    recording: Recording
    sensors: dict[str, str]
    mountings: dict[str, SE2]
    notes: list[str]
    upside_down: frozenset[str]
    events: tuple[str, ...] = ()
    counters: Counter[str] = field(default_factory=Counter)

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        return self.recording.metadata

    @property
    def scan_counts(self) -> dict[str, int]:
        """Laser -> how many of its scans the recording says it holds."""
        return {
            self.sensors[topic.name]: topic.count
            for topic in self.recording.topics
            if topic.type == LASER_SCAN and topic.name in self.sensors
        }

    def frames(self) -> Iterator[Frame]:
        """What `steps` gives, without the wishes in between."""
        return (step for step in self.steps() if not isinstance(step, Step))

    def steps(self) -> Iterator[Frame | Step]:
        """Frames and wishes by rising log time, in our sessions the order in which the mapper had them.

        Where a foreign recording gives a scan and a sample one log time, the sample goes first: a scan that
        is mapped before the odometry of its own moment has to guess the last piece of its way.

        A message that is no use to a mapper is counted and left out. Raises InputError at a damaged place.
        """
        self.counters.clear()
        for message in self._in_order():
            topic = f"/{message.channel}"
            if topic in self.events:
                yield from self._control(message)
                continue
            sensor = self.sensors[topic]
            try:
                frame = decode_frame(message.type, message.payload, sensor, message.log_ns)
            except InputError:
                frame = None
            if frame is None:
                self.counters[f"{topic} unusable"] += 1
                continue
            self.counters[topic] += 1
            if sensor in self.upside_down and isinstance(frame, LaserScan):
                first, step = -frame.first_angle_rad, -frame.angle_step_rad
                frame = replace(frame, first_angle_rad=first, angle_step_rad=step)
            yield frame

    def _in_order(self) -> Iterator[Message]:
        messages = self.recording.messages([*self.sensors, *self.events])
        for _, of_one_time in groupby(messages, key=lambda message: message.log_ns):
            yield from sorted(of_one_time, key=lambda message: message.type == LASER_SCAN)

    def _control(self, event: Message) -> list[Step]:
        try:
            control = decode_control(event.payload, event.log_ns)
        except InputError:
            self.counters[f"/{event.channel} unusable"] += 1
            return []
        return [] if control is None else [control]


def open_session(paths: Sequence[Path]) -> Session:
    """Look into finished recordings. Raises InputError where there is no laser scan that can be mapped."""
    recording = Recording(paths)
    notes: list[str] = []
    readable = [topic for topic in recording.topics if topic.type in FRAME_TYPES and topic.count]
    for topic in [t for t in readable if t.encoding != "cdr"]:
        notes.append(f"passed over {topic}: encoded as {topic.encoding!r}; only ROS 2's cdr is read")
    readable = [topic for topic in readable if topic.encoding == "cdr"]
    ours = [topic for topic in readable if _is_ours(topic)] if _is_our_session(recording) else []
    heads = {topic.name: _head(recording, topic) for topic in ours or readable}
    chosen = ours or _choose(readable, heads, notes)
    sensors = _name_sensors(chosen)
    tree = StaticTree(recording)
    moved = [decode_pose(heads[t.name].payload).child.lstrip("/") for t in chosen if t.type == ODOMETRY]
    bases = tuple(dict.fromkeys([*filter(None, moved), *BASE_FRAMES]))  # what the odometry moves is the base
    mounts: dict[str, Mounting] = {}
    for topic in chosen:
        if topic.type == ODOMETRY or (topic.type == IMU and ours):
            continue
        try:
            sensor_frame = frame_id(topic.type, heads[topic.name].payload)
            mount = mounting(tree, bases, sensor_frame, topic, notes)
            if topic.type == LASER_SCAN:
                mounts[sensors[topic.name]] = mount
            elif mount.upside_down:
                raise TiltedError("mounted upside down")
        except TiltedError as error:
            notes.append(f"passed over {topic}: {error}")
            del sensors[topic.name]
    if not mounts:
        raise InputError(_nothing_to_map(recording, notes))
    used = ", ".join(str(topic) for topic in chosen if topic.name in sensors)
    return Session(
        recording=recording,
        sensors=sensors,
        mountings={sensor: mount.pose_base_sensor for sensor, mount in mounts.items()},
        notes=[f"reading {used}", *notes],
        upside_down=frozenset(sensor for sensor, mount in mounts.items() if mount.upside_down),
        events=tuple(t.name for t in recording.topics if ours and (t.name, t.type) == ("/events", STRING)),
    )


def _is_our_session(recording: Recording) -> bool:
    """By who wrote it; or, where another program rewrote it, by what only we write."""
    by_us = recording.library.startswith("corridor ") or any(t.name == "/pose" for t in recording.topics)
    return by_us and any(_is_ours(t) and t.type == LASER_SCAN for t in recording.topics)


def _is_ours(topic: Topic) -> bool:
    parts = topic.name.split("/")
    return len(parts) == 3 and parts[0] == "" and FRAME_TYPES.get(topic.type) == parts[2]


def _name_sensors(topics: Sequence[Topic]) -> dict[str, str]:
    """ "/front/scan" is "front", "/scan" is "scan", "/robot1/base_scan" is "robot1_base_scan"."""
    names: dict[str, str] = {}
    for topic in topics:
        whole = topic.name.strip("/").replace("/", "_")
        name = whole.removesuffix(f"_{FRAME_TYPES[topic.type]}") or whole
        taken = {names[t.name] for t in topics if t.name in names and t.type == topic.type}
        names[topic.name] = whole if name in taken else name
    return names


def _head(recording: Recording, topic: Topic) -> Message:
    """The first message of a topic that can be read."""
    for message in islice(recording.messages([topic.name]), MOST_BROKEN):
        try:
            frame_id(message.type, message.payload)
        except InputError:
            continue
        return message
    raise InputError(f"{recording.paths[0]}: the first messages of {topic} cannot be read as what they claim")


def _choose(readable: Sequence[Topic], heads: dict[str, Message], notes: list[str]) -> list[Topic]:
    chosen = []
    by_frame: dict[str, list[Topic]] = {}
    for topic in readable:
        if topic.type == LASER_SCAN:
            by_frame.setdefault(frame_id(LASER_SCAN, heads[topic.name].payload), []).append(topic)
    for sensor_frame, topics in by_frame.items():
        chosen += _first(topics, f"another of the laser at {sensor_frame}", ("/scan",), notes)
    odometries = [topic for topic in readable if topic.type == ODOMETRY]
    for topic in [t for t in odometries if decode_pose(heads[t.name].payload).frame == MAP_FRAME]:
        notes.append(f"passed over {topic}: poses in the map are a result, not odometry")
        odometries.remove(topic)
    chosen += _first(odometries, "one odometry is used", ("/odom", "/odometry"), notes)
    imus = [topic for topic in readable if topic.type == IMU]
    chosen += _first(imus, "one IMU is used", ("/imu/data", "/imu"), notes)
    return chosen


def _first(topics: Sequence[Topic], reason: str, preferred: Sequence[str], notes: list[str]) -> list[Topic]:
    """The raw topic: by its usual name, else not a derived one, else the fullest."""

    def rank(topic: Topic) -> tuple[bool, bool, int, str]:
        derived = any(word in topic.name for word in DERIVED)
        return topic.name not in preferred, derived, -topic.count, topic.name

    best, *others = sorted(topics, key=rank) if topics else (None,)
    notes += [f"passed over {topic}: {reason}, {best}" for topic in others]
    return [best] if best is not None else []


def _nothing_to_map(recording: Recording, notes: Sequence[str]) -> str:
    where = ", ".join(map(str, recording.paths))
    held = ", ".join(map(str, recording.topics)) or "nothing"
    reasons = "".join(f"; {note}" for note in notes)
    return f"{where}: no {LASER_SCAN} that can be mapped; it holds {held}{reasons}"
