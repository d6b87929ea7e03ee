"""The 33 bytes beside every sample, as ROS 2's rmw_zenoh lays them out.

Source: ros2/rmw_zenoh, design document, "Message attachments": int64 sequence number, int64 source time,
length of the gid (16), gid; little endian.
"""

import hashlib
import struct
from dataclasses import dataclass

_LAYOUT = struct.Struct("<qqB16s")
GID_BYTES = 16


@dataclass(frozen=True, slots=True)
class Attachment:
    sequence: int  # from 1, rising; of a tile or the map: its version
    source_ns: int  # Unix time at which the service had it
    gid: bytes  # 16 bytes that stand for one publisher in one run of the service

    def encode(self) -> bytes:
        return _LAYOUT.pack(self.sequence, self.source_ns, GID_BYTES, self.gid)

    @staticmethod
    def decode(content: bytes) -> "Attachment":
        """Raises ValueError."""
        if len(content) != _LAYOUT.size or content[16] != GID_BYTES:
            raise ValueError(f"attachment of {len(content)} bytes; expected {_LAYOUT.size} with a gid of 16")
        sequence, source_ns, _, gid = _LAYOUT.unpack(content)
        return Attachment(sequence, source_ns, gid)


def make_gid(session_id: str, channel: str) -> bytes:
    """Stable within a run: the session's id is drawn anew at each start."""
    return hashlib.blake2b(f"{session_id}/{channel}".encode(), digest_size=GID_BYTES).digest()
