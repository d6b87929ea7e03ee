#!/usr/bin/env bash
# rosbags 0.11.9, serialize_cdr: an array of the other byte order is written as it lies in memory, without an error.
#
# Expected: the values of a '>f4' array , converted; or an error, as for float64.
# Found: other values: 1.0 becomes 4.6e-41. float64 in the same field is refused.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check rosbags==0.11.9 numpy==2.4.6

"$work/venv/bin/python" - "$work" > "$work/found" <<'PYTHON'
from importlib.metadata import version

import numpy as np
from rosbags.typesys import Stores, get_typestore

print("rosbags", version("rosbags"))
store = get_typestore(Stores.ROS2_HUMBLE)
time = store.types["builtin_interfaces/msg/Time"](1, 0)
header = store.types["std_msgs/msg/Header"](time, "laser")
LaserScan = store.types["sensor_msgs/msg/LaserScan"]
for order in ("<f4", ">f4", "<f8"):
    ranges = np.array([1.0, 2.0, 3.0], order)
    scan = LaserScan(header, -1.0, 1.0, 1.0, 0.0, 0.1, 0.1, 30.0, ranges, np.zeros(0, "<f4"))
    try:
        payload = store.serialize_cdr(scan, scan.__msgtype__)
        read = store.deserialize_cdr(payload, scan.__msgtype__).ranges.tolist()
        print(order, "given", ranges.tolist(), "read", [float(f"{value:.3g}") for value in read])
    except ValueError:
        print(order, "given", ranges.tolist(), "ValueError")
PYTHON
cat "$work/found"
diff - "$work/found" <<'END' || { echo "rosbags treats arrays of the other byte order in another manner now"; exit 1; }
rosbags 0.11.9
<f4 given [1.0, 2.0, 3.0] read [1.0, 2.0, 3.0]
>f4 given [1.0, 2.0, 3.0] read [4.6e-41, 8.97e-44, 2.3e-41]
<f8 given [1.0, 2.0, 3.0] ValueError
END
