"""The devices in a recording, and those chosen for the mapper.

They are found by type; where several fit, one is chosen, and the notes list what was skipped. Each
header.frame_id in a topic is a device of its own.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count, islice

from service.encoding import (
    IMU,
    LASER_SCAN,
    MAP_FRAME,
    MULTI_ECHO_SCAN,
    NAV_SAT_FIX,
    ODOMETRY,
    POINT_CLOUD,
    Message,
    frame_id,
    read,
)
from service.errors import InputError, UsageError
from service.recording.mcap_reader import Readable, Topic

FRAME_TYPES = {LASER_SCAN: "scan", IMU: "imu", ODOMETRY: "odom", NAV_SAT_FIX: "fix"}  # of our sessions
LASER_TYPES = (LASER_SCAN, MULTI_ECHO_SCAN)
SCAN_TYPES = (*LASER_TYPES, POINT_CLOUD)
ENDINGS = {**FRAME_TYPES, MULTI_ECHO_SCAN: "scan", POINT_CLOUD: "points"}
SAMPLED = 100  # messages at the beginning of a topic: what is not among them is not expected later
SAMPLED_CLOUDS = 10
DERIVED = ("filter", "fused", "icp", "visual", "amcl", "slam", "merged")  # made by others from the raw topic
CLOUD_TOPICS = ("/points", "/velodyne_points", "/ouster/points", "/rslidar_points", "/livox/lidar")
_ONE_OF = {  # why others are passed over, and the usual names
    ODOMETRY: ("one odometry is used", ("/odom", "/odometry")),
    NAV_SAT_FIX: ("one GNSS receiver is used", ("/fix", "/gps/fix")),
    IMU: ("one IMU is used", ("/imu/data", "/imu")),
}


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """One device: the messages of a topic with one header.frame_id."""

    topic: Topic
    frame: str
    head: Message  # the first that can be read
    share: float  # of the messages at the beginning of the topic; 1: it is alone there

    def __str__(self) -> str:
        return str(self.topic) if self.share == 1.0 else f"frame_id {self.frame!r} in {self.topic}"


def sources_of(recording: Readable, topic: Topic) -> list[Source]:
    """The devices at the beginning of a topic, the one that sends most first."""
    heads: dict[str, Message] = {}
    counts: Counter[str] = Counter()
    for message in islice(
        recording.messages([topic.name]), SAMPLED_CLOUDS if topic.type == POINT_CLOUD else SAMPLED
    ):
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
    return [Source(topic, f, heads[f], count / counts.total()) for f, count in counts.most_common()]


def name_sensors(chosen: Sequence[Source], sources: Mapping[str, Sequence[Source]]) -> dict[Source, str]:
    """ "/front/scan" is "front", "/scan" is "scan", "/robot1/base_scan" is "robot1_base_scan".

    Where devices share a topic, the first is called so, and the others "front_<frame_id>". Of two of a kind
    that would have one name, the second is called "front_2".
    """
    of_topics: dict[str, str] = {}
    topics = list(dict.fromkeys(source.topic for source in chosen))
    for topic in topics:
        full_name = topic.name.strip("/").replace("/", "_")
        name = full_name.removesuffix(f"_{ENDINGS[topic.type]}") or full_name
        taken = {of_topics[t.name] for t in topics if t.name in of_topics and kind_of(t) == kind_of(topic)}
        of_topics[topic.name] = full_name if name in taken else name
    names: dict[Source, str] = {}
    for source in chosen:
        name = of_topics[source.topic.name]
        if source is not sources[source.topic.name][0]:
            name += f"_{source.frame.replace('/', '_')}"
        likes = chain([name], (f"{name}_{number}" for number in count(2)))
        others = {names[s] for s in names if kind_of(s.topic) == kind_of(source.topic)}
        names[source] = next(one for one in likes if one not in others)
    return names


def kind_of(topic: Topic) -> str:
    """As in FRAME_TYPES; of all that becomes a scan "scan"."""
    return FRAME_TYPES.get(topic.type, "scan")


def all_of_ours(sources: Mapping[str, Sequence[Source]]) -> list[Source]:
    return [
        source
        for of_topic in sources.values()
        for source in of_topic
        if source is of_topic[0] or source.topic.type in SCAN_TYPES
    ]


def choose_scans(sources: Mapping[str, Sequence[Source]], notes: list[str]) -> list[Source]:
    """Every laser once. Without a laser one point cloud."""
    by_frame: dict[str, list[Source]] = {}
    for source in chain.from_iterable(sources.values()):
        if source.topic.type in LASER_TYPES:
            by_frame.setdefault(source.frame, []).append(source)
    chosen: list[Source] = []
    for sensor_frame, of_laser in by_frame.items():
        chosen += _first(of_laser, f"another of the laser at {sensor_frame}", ("/scan",), notes)
    clouds = [of_topic[0] for of_topic in sources.values() if of_topic[0].topic.type == POINT_CLOUD]
    return chosen or _first(clouds, "one point cloud is used", CLOUD_TOPICS, notes)


def choose_one(
    sources: Mapping[str, Sequence[Source]],
    type_name: str,
    is_own: Callable[[Source], bool],
    notes: list[str],
) -> list[Source]:
    """The one device of that type, of the fullest in each topic; one that is not the vehicle's own only where
    there is no other.
    """
    firsts = [of_topic[0] for of_topic in sources.values() if of_topic[0].topic.type == type_name]
    if type_name == ODOMETRY:
        for source in [s for s in firsts if s.frame == MAP_FRAME]:
            notes.append(f"passed over {source}: poses in the map are a result, not odometry")
            firsts.remove(source)
    own = [source for source in firsts if is_own(source)]
    if own:
        notes += [
            f"passed over {s}: of another vehicle's base than the laser" for s in firsts if s not in own
        ]
    return _first(own or firsts, *_ONE_OF[type_name], notes)


def _first(
    sources: Sequence[Source], reason: str, preferred: Sequence[str], notes: list[str]
) -> list[Source]:
    """From the raw topic: not a shared one, by its usual name, else not a derived one, else the fullest."""

    def rank(source: Source) -> tuple[bool, bool, bool, bool, int, str]:
        name = source.topic.name
        derived = any(word in name for word in DERIVED)
        is_other = source.topic.type == MULTI_ECHO_SCAN
        return source.share < 1.0, is_other, name not in preferred, derived, -source.topic.count, name

    best, *others = sorted(sources, key=rank) if sources else (None,)
    notes += [f"passed over {source}: {reason}, {best}" for source in others]
    return [best] if best is not None else []


def named_topic(recording: Readable, option: str, name: str, types: Sequence[str]) -> Topic:
    """Raises UsageError where there is no such topic of one of these types, with those that are."""
    wanted = f"/{name.lstrip('/')}"
    readable = [topic for topic in recording.topics if topic.type in types and topic.count]
    for topic in readable:
        if f"/{topic.name.lstrip('/')}" == wanted:
            if topic.encoding != "cdr":
                raise UsageError(f"{option} {name}: encoded as {topic.encoding!r}; only ROS 2's cdr is read")
            return topic
    others = [topic for topic in recording.topics if f"/{topic.name.lstrip('/')}" == wanted]
    why = f"is {others[0]}" if others else "no such topic"
    raise UsageError(
        f"{option} {name}: {why}; {recording.paths[0]} has "
        f"{', '.join(map(str, readable)) or f'no {chr(32).join(types)}'}"
    )
