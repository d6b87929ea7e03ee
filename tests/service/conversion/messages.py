"""Messages of other lasers than those that send LaserScan."""

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_jazzy as ros

from service import encoding

STORE = get_typestore(Stores.ROS2_JAZZY)
STAMP_NS = 1_700_000_000_250_000_000
FORMATS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def header(stamp_ns):
    stamp = ros.builtin_interfaces__msg__Time(stamp_ns // 10**9, stamp_ns % 10**9)
    return ros.std_msgs__msg__Header(stamp, "front")


def echoes(ranges, intensities, sweep, stamp_ns=STAMP_NS):
    """The payload of a scan with the echoes of each beam. sweep: the fields from angle_min to range_max."""

    def of_beams(beams):
        return [ros.sensor_msgs__msg__LaserEcho(np.array(beam, np.float32)) for beam in beams]

    content = ros.sensor_msgs__msg__MultiEchoLaserScan(
        header(stamp_ns), *sweep, of_beams(ranges), of_beams(intensities)
    )
    return bytes(STORE.serialize_cdr(content, encoding.MULTI_ECHO_SCAN))


def cloud(columns, formats=None, height=1, big_endian=False, padding=0, row_padding=0, stamp_ns=STAMP_NS):
    """The payload of a cloud. columns: name -> values (N,); formats: name -> as in numpy, else f4."""
    order, formats = ">" if big_endian else "<", formats or {}
    count = len(next(iter(columns.values())))
    kinds = {name: np.dtype(order + formats.get(name, "f4")) for name in columns}
    offsets, at = {}, padding
    for name, kind in kinds.items():
        offsets[name], at = at, at + kind.itemsize + padding
    columns_of = {"names": list(kinds), "formats": list(kinds.values()), "offsets": list(offsets.values())}
    whole = np.dtype(columns_of | {"itemsize": at})
    points = np.zeros(count, whole)
    for name, values in columns.items():
        points[name] = values
    width = count // height
    rows = [points[k * width : (k + 1) * width].tobytes() + b"\xff" * row_padding for k in range(height)]
    content = ros.sensor_msgs__msg__PointCloud2(
        header(stamp_ns),
        height,
        width,
        [
            ros.sensor_msgs__msg__PointField(name, offsets[name], FORMATS[formats.get(name, "f4")], 1)
            for name in columns
        ],
        big_endian,
        at,
        width * at + row_padding,
        np.frombuffer(b"".join(rows), np.uint8),
        False,
    )
    return bytes(STORE.serialize_cdr(content, encoding.POINT_CLOUD))
