"""What happened on a device's wire <-> std_msgs/UInt8MultiArray, as channel "<sensor>/raw"."""

from typing import cast, get_args

import numpy as np

from drivers.link import ChunkKind, RawChunk
from service.encoding import ros_messages as ros
from service.encoding import wire
from service.encoding.wire import Message
from service.errors import InputError

KINDS: tuple[ChunkKind, ...] = get_args(ChunkKind)


def encode_raw(sensor: str, chunk: RawChunk, utc_offset_ns: int) -> Message:
    """The chunk's bytes; what kind it is stands as label of the array's one dimension.

    Stamp and log time are the chunk's own to the nanosecond: drivers reckon with it.
    """
    at_ns = chunk.at_ns + utc_offset_ns
    size = len(chunk.data)
    layout = ros.std_msgs__msg__MultiArrayLayout(
        [ros.std_msgs__msg__MultiArrayDimension(chunk.kind, size, size)], data_offset=0
    )
    content = ros.std_msgs__msg__UInt8MultiArray(layout, np.frombuffer(chunk.data, dtype=np.uint8))
    return wire.to_message(f"{sensor}/raw", wire.BYTES, at_ns, at_ns, content)


def decode_raw(payload: bytes, log_ns: int, utc_offset_ns: int) -> RawChunk:
    """Raises InputError."""
    m = cast(ros.std_msgs__msg__UInt8MultiArray, wire.read(wire.BYTES, payload))
    label = m.layout.dim[0].label if m.layout.dim else ""
    kind = next((kind for kind in KINDS if kind == label), None)
    if kind is None:
        raise InputError(f"raw bytes labelled {label!r}; expected {', '.join(KINDS)}")
    return RawChunk(log_ns - utc_offset_ns, kind, m.data.tobytes())
