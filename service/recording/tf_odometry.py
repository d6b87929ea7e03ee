"""Odometry of robots that publish it in /tf only: the edge from its frame to the base, as
nav_msgs/Odometry.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from drivers.frames import OdometrySample
from service.encoding import (
    BASE_FRAME,
    ODOM_FRAME,
    ODOMETRY,
    TF,
    Message,
    Transform,
    decode_transforms,
    encode_frame,
)
from service.errors import InputError
from service.recording.choice import Choice
from service.recording.mcap_reader import Readable, Topic
from service.recording.mountings import place_of

ODOM_OF_TF = "/tf/odom"  # the topic that it is given out as; no recording can have it besides /tf
Edge = tuple[str, str]  # frame above, frame below
BASE_FRAMES = (BASE_FRAME, "base_footprint")
ODOM_FRAMES = (ODOM_FRAME, "odom_combined")
_BASE = re.compile(rf"(?P<robot>|.*[/_])({'|'.join(BASE_FRAMES)})")
_ODOMETRY = re.compile(rf"(|.*[/_])({'|'.join(ODOM_FRAMES)})")


class WithOdometryOfTf:
    """A recording, and one moving edge of its /tf besides, as the Odometry ODOM_OF_TF."""

    def __init__(self, recording: Readable, edge: Edge, samples: int) -> None:
        self.edge = edge
        self.paths = recording.paths
        self.library = recording.library
        self.first_log_ns, self.last_log_ns = recording.first_log_ns, recording.last_log_ns
        self.metadata = recording.metadata
        self.losses = recording.losses
        self.topics = [*recording.topics, Topic(ODOM_OF_TF, ODOMETRY, "cdr", samples)]
        self._recording = recording
        self._tf = set(moving_tf(recording))

    def messages(
        self, topics: Collection[str] | None = None, from_ns: int | None = None, to_ns: int | None = None
    ) -> Iterator[Message]:
        """Messages of the recording, with the odometry among them."""
        if topics is None or ODOM_OF_TF not in topics:
            yield from self._recording.messages(topics, from_ns, to_ns)
            return
        wanted, tf = _channels(topics), _channels(self._tf)
        for message in self._recording.messages(self._tf.union(topics), from_ns, to_ns):
            if message.channel in wanted:
                yield message
            if message.channel in tf:
                yield from self._odometry(message)

    def _odometry(self, tf: Message) -> Iterator[Message]:
        for transform in _transforms(tf):
            if (transform.frame, transform.child) == self.edge:
                x_m, y_m, heading_rad = transform.pose.x_m, transform.pose.y_m, transform.pose.theta_rad
                yield encode_frame(
                    OdometrySample(
                        "tf",
                        transform.stamp_ns,
                        tf.log_ns,
                        x_m,
                        y_m,
                        heading_rad,
                        (0.0, 0.0, 0.0),
                        (0.0,) * 9,
                    )
                )


def _channels(topics: Collection[str]) -> set[str]:
    """Channels of the messages of these topics, which not every writer begins with a slash."""
    return {name.removeprefix("/") for name in topics}


def moving_tf(recording: Readable) -> list[str]:
    """Topics of transforms that may change."""
    return [t.name for t in recording.topics if t.type == TF and not t.name.endswith("tf_static") and t.count]


@dataclass(slots=True)
class Edges:
    """Number of messages of each edge of /tf, and which edges change."""

    counts: Counter[Edge] = field(default_factory=Counter)
    changed: set[Edge] = field(default_factory=set)

    def in_words(self, edges: Iterable[Edge]) -> str:
        """ "odom to base_link (500), ..."."""
        return ", ".join(f"{frame} to {child} ({self.counts[frame, child]})" for frame, child in edges)


def edges_of(recording: Readable) -> Edges:
    """The edges of /tf, by one walk through it."""
    found, names = Edges(), moving_tf(recording)
    firsts: dict[Edge, Transform] = {}
    for message in recording.messages(names) if names else ():
        for transform in _transforms(message):
            edge = transform.frame, transform.child
            found.counts[edge] += 1
            if place_of(firsts.setdefault(edge, transform)) != place_of(transform):
                found.changed.add(edge)
    return found


def odometry_edge(edges: Edges, choice: Choice, under_base: Collection[str], robot: str | None) -> list[Edge]:
    """Edges that may be the odometry, the likeliest first: several only of several robots.

    under_base   frames above the chosen lasers
    robot        prefix of the base's frame, None where it is not known
    """
    fitting = [
        (frame, child)
        for frame, child in edges.counts
        if (frame == choice.odom_frame if choice.odom_frame else is_odometry(frame))
        and (child == choice.base_frame if choice.base_frame else child in under_base or is_base(child))
        and (robot is None or not is_base(child) or robot_of(child) == robot)
    ]
    fitting.sort(key=lambda edge: (edge[1] not in under_base, -edges.counts[edge], edge))
    own: dict[str, Edge] = {}
    for edge in fitting:
        own.setdefault(robot_of(edge[1]), edge)
    return list(own.values())


def _transforms(tf: Message) -> Sequence[Transform]:
    try:
        return decode_transforms(tf.payload)
    except InputError:
        return ()


def is_odometry(frame: str) -> bool:
    """Whether it is the name of an odometry's frame: odom, robot1/odom, robot1_odom."""
    return _ODOMETRY.fullmatch(frame) is not None


def is_base(frame: str) -> bool:
    """Whether it is the name of a base: base_link, robot1/base_footprint, robot1_base_link."""
    return _BASE.fullmatch(frame) is not None


def robot_of(frame: str) -> str:
    """ "robot1/" of "robot1/base_link", "robot1_" of "robot1_base_link"; of others what is before a /."""
    match = _BASE.fullmatch(frame)
    return match["robot"] if match else frame[: frame.rfind("/") + 1]
