"""Frames of recordings, for the replay: our own sessions, and those of any other ROS system.

In a session of ours a sensor's topics are `/<sensor>/scan`, `imu`, `odom` and `fix`. In others they are
found by type, see sources, unless a Choice names them.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, islice
from pathlib import Path
from typing import Any

from drivers.counted import counted
from drivers.frames import Frame, LaserScan
from service.encoding import (
    LASER_SCAN,
    MAP_FRAME,
    NO_COVARIANCE,
    NO_ROTATION,
    ODOMETRY,
    STRING,
    Message,
    decode_frame,
    decode_step,
    frame_id,
    odometry_fault,
    scan_fault,
    span_fault,
)
from service.errors import InputError
from service.geometry.se2 import SE2
from service.limits import MAX_SENSOR_TOPICS, check
from service.mapper.mapping_session import Step
from service.recording.choice import NO_CHOICE, Choice
from service.recording.mcap_reader import Readable, Topic
from service.recording.opening import open_recording
from service.recording.sources import ENDINGS, FRAME_TYPES, LASER_TYPES, SCAN_TYPES, kind_of
from service.recording.vehicle import Converter, Vehicle

# A sweep so wide takes most of a laser's period; those of one instant are flash sensors, and narrower.
MAX_INSTANT_DEG = 200.0
MAX_LOG_NS = 2**63 - 1
INSTANT = "instant"  # scans that report it nevertheless
SPAN = "span"  # scans of which span_fault has something to say


@dataclass(slots=True)
class Session:
    """The contents of a recording for a mapper.

    devices        topic -> frame_id -> sensor name; the topics and devices whose frames come out
    scan_counts    laser -> how many of its scans the recording states; where several devices share a
                   topic, by their shares at its beginning
    mountings      sensor name -> pose_base_sensor, for lasers; from /tf_static
    antennas       the same for GNSS antennas, "<sensor>/antenna" where one is distinguished from its sensor
    metadata       config, calibration, clocks as written by the recorder; empty in foreign recordings
    upside_down    sensors that are mounted so; their values are turned back
    unmounted      lasers taken as sitting at the base's origin, for their mounting is unknown -> why
    events         topics whose events may be requests to the mapping session: ours has one, others have none
    converters     sensors whose messages are no LaserScan -> what makes scans of them
    warnings       what was chosen, or not found, and may not be what is meant; for people
    notes          what was chosen and what was passed over, one line each, to be shown
    counters       filled while reading: frames by topic, messages without usable content, those refused
                   because of a frame_id that is not expected, by topic the text of odometry_fault, scans
                   all around that claim to be of one moment, and those with a span_fault
    examples       filled while reading: "<topic> unusable", "<topic> span" -> what the first scan has wrong
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
    warnings: Sequence[str] = ()
    converters: Mapping[str, Converter] = field(default_factory=dict)
    counters: Counter[str] = field(default_factory=Counter)
    examples: dict[str, str] = field(default_factory=dict)
    frame_ids: dict[str, Counter[str]] = field(default_factory=dict)

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        return self.recording.metadata

    @property
    def sensors(self) -> dict[str, str]:
        """Topic -> sensor; where several share a topic, the first."""
        return {topic: next(iter(sensors.values())) for topic, sensors in self.devices.items()}

    @property
    def topics_of(self) -> dict[tuple[str, str], str]:
        """(kind, sensor) -> its topic; kinds as of sources.kind_of."""
        kinds = {topic.name: kind_of(topic) for topic in self.recording.topics if topic.name in self.devices}
        return {
            (kinds[topic], sensor): topic
            for topic, sensors in self.devices.items()
            for sensor in sensors.values()
        }

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
        """Unreadable parts of the files, and unusable messages: one line a
        file or topic, to be shown.
        """
        lines = list(self.recording.losses)
        for topic in self.devices:
            unusable, rotation, covariance = (
                self.counters[f"{topic} {what}"] for what in ("unusable", NO_ROTATION, NO_COVARIANCE)
            )
            read = self.counters[topic] + unusable
            if unusable:
                why = f"; the orientation of {rotation} is a quaternion of 0" if rotation else ""
                if example := self.examples.get(f"{topic} unusable"):
                    why = f"; of the first {example}"
                lines.append(f"{topic}: {unusable} of {counted(read, 'message')} cannot be used{why}")
            if covariance:
                lines.append(
                    f"{topic}: the covariance of {covariance} of {counted(read, 'message')} is none (not "
                    "finite, or beyond all sense) and counts as unknown; their poses are used"
                )
            if spans := self.counters[f"{topic} {SPAN}"]:
                example = self.examples[f"{topic} {SPAN}"]
                lines.append(
                    f"{topic}: angle_max of {counted(spans, 'scan')} (of {read}) is not where the beams "
                    f"end; of the first {example}. angle_increment is used: if it is wrong, "
                    "map and poses are. Does a filter change the number of ranges?"
                )
            if instant := self.counters[f"{topic} {INSTANT}"]:
                lines.append(
                    f"{topic}: {counted(instant, 'scan')} (of {read}) of more than {MAX_INSTANT_DEG:.0f} "
                    "deg with a time_increment of 0, or with points that have no times: all beams count as "
                    "measured at once; if this laser rotates, turns bend its scans and the map. Does its "
                    "driver set them?"
                )
        return lines

    def topic_of(self, message: Message) -> str:
        """Topic as the recording names it: in ROS with a slash ahead, by other writers perhaps without."""
        name = f"/{message.channel}"
        return name if name in self.devices or name in self.events else message.channel

    def frames(self) -> Iterator[Frame]:
        """Frames of `steps`, without the requests."""
        return (step for step in self.steps() if not isinstance(step, Step))

    def steps(self) -> Iterator[Frame | Step]:
        """Frames and requests by rising log time, in our sessions the order in which the mapper had them.

        Where a foreign recording gives a scan and a sample one log time, the sample goes first: a scan that
        is mapped before the odometry of its own moment has to guess the last part of its motion.

        An unusable message is counted and left out. Raises InputError at a damaged place.
        """
        self.counters.clear()
        self.examples.clear()
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
                frame = self.decode(message, sensor) if message.log_ns <= MAX_LOG_NS else None
            except InputError:
                frame = None
            if message.type == ODOMETRY and (fault := odometry_fault(message.payload)):
                self.counters[f"{topic} {fault}"] += 1
            if frame is None or sensor is None:
                self.counters[f"{topic} unusable"] += 1
                if fault := _log_fault(message) or scan_fault(message.type, message.payload):
                    self.examples.setdefault(f"{topic} unusable", fault)
                continue
            self.counters[topic] += 1
            if message.type in LASER_TYPES and (fault := span_fault(message.payload)):
                self.counters[f"{topic} {SPAN}"] += 1
                self.examples.setdefault(f"{topic} {SPAN}", fault)
            if isinstance(frame, LaserScan) and _is_instant(frame):
                self.counters[f"{topic} {INSTANT}"] += 1
            yield frame

    def decode(self, message: Message, sensor: str) -> Frame | None:
        """Content of a message of one of the devices, see encoding.decode_frame. Raises InputError."""
        if (convert := self.converters.get(sensor)) is not None:
            return convert(message.payload, sensor, message.log_ns)
        over = sensor in self.upside_down
        return decode_frame(message.type, message.payload, sensor, message.log_ns, over)

    def _in_order(self) -> Iterator[Message]:
        messages = self.recording.messages([*self.devices, *self.events])
        for _, of_one_time in groupby(messages, key=lambda message: message.log_ns):
            yield from sorted(of_one_time, key=lambda message: message.type in SCAN_TYPES)

    def _step(self, event: Message) -> list[Step]:
        try:
            step = decode_step(event.payload, event.log_ns)
        except InputError:
            self.counters[f"/{event.channel} unusable"] += 1
            return []
        return [] if step is None else [step]


def _log_fault(message: Message) -> str:
    """Of a log time that MCAP can hold and no int64; "" for others."""
    return f"the log time is {message.log_ns} ns" if message.log_ns > MAX_LOG_NS else ""


def _is_instant(scan: LaserScan) -> bool:
    """Whether beams all around claim to be of one moment."""
    span_rad = (len(scan.range_m) - 1) * abs(scan.angle_step_rad)
    return scan.beam_interval_ns == 0 and span_rad > math.radians(MAX_INSTANT_DEG)


def open_session(paths: Sequence[Path], choice: Choice = NO_CHOICE) -> Session:
    """Open finished recordings. Raises InputError where there is no laser scan that can be mapped, and
    UsageError where the choice names what is not there.
    """
    recording = open_recording(paths)
    notes: list[str] = []
    readable = [topic for topic in recording.topics if topic.type in ENDINGS and topic.count]
    for topic in [t for t in readable if t.encoding != "cdr"]:
        notes.append(f"passed over {topic}: encoded as {topic.encoding!r}; only ROS 2's cdr is read")
    readable = [topic for topic in readable if topic.encoding == "cdr"]
    check(len(readable), MAX_SENSOR_TOPICS, f"{recording.paths[0]}: topics of sensors", "topics")
    _refuse_two_types(recording, readable)
    ours = [topic for topic in readable if _is_ours(topic)] if _is_our_session(recording) else []
    vehicle = Vehicle(recording, choice, notes)
    chosen = vehicle.all_of(ours) if ours and choice.is_open else vehicle.choose(ours or readable)
    found = vehicle.devices(chosen)
    devices: dict[str, dict[str, str]] = {}
    for source, sensor in found.sensors.items():
        devices.setdefault(source.topic.name, {})[source.frame] = sensor
    return Session(
        recording=found.recording,
        devices=devices,
        scan_counts={
            sensor: round(source.share * source.topic.count)
            for source, sensor in found.sensors.items()
            if source.topic.type in SCAN_TYPES
        },
        mountings=found.mountings,
        notes=[f"reading {', '.join(map(str, found.sensors))}", *found.notes],
        upside_down=frozenset(found.upside_down),
        unmounted=found.unmounted,
        antennas=found.antennas,
        events=tuple(t.name for t in recording.topics if ours and (t.name, t.type) == ("/events", STRING)),
        warnings=found.warnings,
        converters=found.converters,
    )


def _refuse_two_types(recording: Readable, readable: Sequence[Topic]) -> None:
    types = {topic.name: topic.type for topic in readable}
    for topic in recording.topics:
        if topic.count and topic.type != (other := types.get(topic.name, topic.type)):
            raise InputError(
                f"{recording.paths[0]}: {topic.name} holds messages of two types, {other} and {topic.type}; "
                "what it is meant to be is not known. Record them under two names, or take one out"
            )


def _is_our_session(recording: Readable) -> bool:
    """Whether we wrote it, or another program recorded the topics of our service."""
    has_scans = any(_is_ours(t) and t.type == LASER_SCAN for t in recording.topics)
    return has_scans and (recording.library.startswith("corridor ") or _has_our_pose(recording))


def _has_our_pose(recording: Readable) -> bool:
    """Whether /pose is that of the base in the map; others publish a PoseStamped, or the wheels, there."""
    if not any(t.name == "/pose" and t.type == ODOMETRY for t in recording.topics):
        return False
    try:
        return any(frame_id(m.payload) == MAP_FRAME for m in islice(recording.messages(["/pose"]), 1))
    except InputError:
        return False


def _is_ours(topic: Topic) -> bool:
    parts = topic.name.split("/")
    return len(parts) == 3 and parts[0] == "" and FRAME_TYPES.get(topic.type) == parts[2]
