"""Keys, liveliness tokens and attachments as ROS 2's middleware rmw_zenoh_cpp lays them out; no I/O.

Source: ros2/rmw_zenoh, docs/design.md and liveliness_utils.cpp (0.2.4 and later, all distributions since
Humble). A ROS process that receives a sample without a well-formed attachment aborts.
"""

import hashlib
import re
import struct
from dataclasses import dataclass
from typing import Literal

Distro = Literal["humble", "jazzy", "kilted", "rolling"]
NO_TYPE_HASH = "TypeHashNotSupported"  # what stands for the hash in Humble, which has none

GID_BYTES = 16
DEFAULT_DEPTH = 42  # of a history whose depth is left open
ADMIN_SPACE = "@ros2_lv"

_ATTACHMENT = struct.Struct("<qqB16s")


@dataclass(frozen=True, slots=True)
class Attachment:
    """The 33 bytes beside every sample, request and response: little endian, the gid after its length."""

    sequence: int  # from 1, rising; of a tile or the map: its version
    source_ns: int  # Unix time at which the service had it
    gid: bytes  # 16 bytes that identify one publisher in one run of the service

    def encode(self) -> bytes:
        return _ATTACHMENT.pack(self.sequence, self.source_ns, GID_BYTES, self.gid)

    @staticmethod
    def decode(content: bytes) -> "Attachment":
        """Raises ValueError."""
        if len(content) != _ATTACHMENT.size or content[16] != GID_BYTES:
            raise ValueError(
                f"attachment of {len(content)} bytes; expected {_ATTACHMENT.size} with a gid of {GID_BYTES}"
            )
        sequence, source_ns, _, gid = _ATTACHMENT.unpack(content)
        return Attachment(sequence, source_ns, gid)


def make_gid(session_id: str, name: str) -> bytes:
    """Stable within a run: each start draws another session id."""
    return hashlib.blake2b(f"{session_id}/{name}".encode(), digest_size=GID_BYTES).digest()


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service of an endpoint: reliable, keep last, and no deadline, lifespan or lease."""

    depth: int = 10
    is_transient_local: bool = False

    def encode(self) -> str:
        """reliability:durability:history,depth:deadline:lifespan:liveliness; a default is left empty."""
        durability = "1" if self.is_transient_local else ""
        depth = "" if self.depth == DEFAULT_DEPTH else str(self.depth)
        return f":{durability}:,{depth}:,:,:,,"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic or a service."""

    name: str  # complete, with a leading slash: "/veh1/front/scan"
    type: str  # ROS 2 name: "sensor_msgs/msg/LaserScan"
    type_hash: str  # "RIHS01_...", or NO_TYPE_HASH

    def key(self, domain: int) -> str:
        """On which its samples are put, or its requests answered."""
        return f"{domain}/{self.name.lstrip('/')}/{dds_type(self.type)}/{self.type_hash}"


EndpointKind = Literal["MP", "MS", "SS", "SC"]  # publisher, subscription, service, client


@dataclass(frozen=True, slots=True)
class Node:
    """The node of a Zenoh session in ROS 2's graph. Its tokens make it and its endpoints visible."""

    domain: int
    session_id: str  # zid, as text
    name: str
    namespace: str = ""  # "/veh1"

    def token(self) -> str:
        return self._prefix(0, "NN")

    def endpoint_token(self, number: int, kind: EndpointKind, topic: Topic, qos: Qos) -> str:
        """number: of the endpoint within the session, no two alike."""
        return (
            f"{self._prefix(number, kind)}/{_mangled(topic.name)}/{dds_type(topic.type)}/{topic.type_hash}/"
            f"{qos.encode()}"
        )

    def _prefix(self, number: int, kind: str) -> str:
        """With % for the enclave, which is none."""
        return (
            f"{ADMIN_SPACE}/{self.domain}/{self.session_id}/0/{number}/{kind}/%/"
            f"{_mangled(self.namespace)}/{self.name}"
        )


_NAME = r"[A-Za-z_][A-Za-z0-9_]*"


def absolute_name(text: str) -> str:
    """A topic or namespace with a leading slash and none behind; "" for the root. Raises ValueError."""
    name = text.strip("/")
    if name and (not re.fullmatch(rf"{_NAME}(/{_NAME})*", name) or "__" in name):
        raise ValueError(
            'ROS 2 names are letters, digits and single _ between slashes, no digit first, as in "site/veh1"'
        )
    return name and f"/{name}"


def dds_type(ros_type: str) -> str:
    """The name of a message or service in keys: sensor_msgs::msg::dds_::LaserScan_"""
    package, kind, name = ros_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _mangled(name: str) -> str:
    """A name as one chunk of a key."""
    return name.replace("/", "%") or "%"
