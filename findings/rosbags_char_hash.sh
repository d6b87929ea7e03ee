#!/bin/sh
# rosbags 0.11.9: type hashes of messages and services with a `char` field.
# Expected: RIHS01 hashes as ROS 2 makes them, in which `char` of a .msg file is a uint8 (type_id 3); for
#           example_interfaces/srv/AddTwoInts the hash in rmw_zenoh's design document,
#           RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a.
# Found: hash_rihs01 takes type_id 13 for `char`. service_msgs/msg/ServiceEventInfo has a char[16], and the hash
#        of every service covers it, so that of AddTwoInts is another; with uint8[16] in its place it is right.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check rosbags==0.11.9
"$folder/venv/bin/python" - <<'PYTHON'
import importlib.metadata
import sys

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

PUBLISHED = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
INFO, SERVICE = "service_msgs/msg/ServiceEventInfo", "example_interfaces/srv/AddTwoInts"
int64 = (Nodetype.BASE, ("int64", 0))


def nested(name, most=0):
    kind = (Nodetype.NAME, name)
    return (Nodetype.SEQUENCE, (kind, most)) if most else kind


def hash_with(element):
    store = get_typestore(Stores.ROS2_JAZZY)
    constants, fields = store.fielddefs[INFO]
    gid = (Nodetype.ARRAY, ((Nodetype.BASE, (element, 0)), 16))
    defs = store.fielddefs
    defs[INFO] = (constants, [(name, gid if name == "client_gid" else kind) for name, kind in fields])
    request, response, event = (f"{SERVICE}_{part}" for part in ("Request", "Response", "Event"))
    defs[request] = ([], [("a", int64), ("b", int64)])
    defs[response] = ([], [("sum", int64)])
    defs[event] = ([], [("info", nested(INFO)), ("request", nested(request, 1)), ("response", nested(response, 1))])
    parts = (("request_message", request), ("response_message", response), ("event_message", event))
    defs[SERVICE] = ([], [(name, nested(kind)) for name, kind in parts])
    return store.hash_rihs01(SERVICE)


print("rosbags", importlib.metadata.version("rosbags"))
fields = dict(get_typestore(Stores.ROS2_JAZZY).fielddefs[INFO][1])
print("client_gid in its store:", fields["client_gid"])
as_it_is, as_uint8 = hash_with("char"), hash_with("uint8")
print("published:      ", PUBLISHED)
print("with char[16]:  ", as_it_is)
print("with uint8[16]: ", as_uint8)
sys.exit(0 if as_it_is != PUBLISHED and as_uint8 == PUBLISHED else 1)
PYTHON
