"""Keep a copy of a vehicle's map:  python mirror.py tcp/127.0.0.1:7447 veh1

The steps of docs/subscribing.md, "Versions of the map"; needs `pip install eclipse-zenoh rosbags` alone.
"""

import json
import struct
import sys
import threading
import time

import zenoh
from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.ROS2_JAZZY)


class MapMirror:
    """The newest version of every tile, from samples in any order and in any number."""

    def __init__(self):
        self.tiles = {}  # key -> (version, payload)
        self.complete_to = 0  # nothing up to this version is missing
        self.run = None  # publisher of the tiles
        self.lock = threading.Lock()

    def apply(self, key, payload, attachment):
        """Take a tile in; its run and version."""
        version, _, _, run = struct.unpack("<qqB16s", attachment)
        with self.lock:
            if run != self.run:
                self.tiles, self.complete_to, self.run = {}, 0, run
            if version > self.tiles.get(key, (0, b""))[0]:
                self.tiles[key] = (version, payload)
        return run, version

    def fetched(self, brought):
        """A get is over and brought these (run, version)."""
        with self.lock:
            self.complete_to = max(
                [self.complete_to, *(version for run, version in brought if run == self.run)]
            )

    def cells(self, key):
        """A tile as (rows, columns) of -1 unknown, 0 free ... 100 occupied, row 0 lowest."""
        grid = TYPES.deserialize_cdr(self.tiles[key][1], "nav_msgs/msg/OccupancyGrid")
        return grid.data.reshape(grid.info.height, grid.info.width)


def connect(endpoint):
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def follow(session, vehicle, mirror):
    """Subscribe; returns the subscriber and a function to call at once, then now and then."""
    tiles = f"corridor/v1/{vehicle}/map/tile/**"

    def take(sample):
        return mirror.apply(str(sample.key_expr), sample.payload.to_bytes(), sample.attachment.to_bytes())

    def fetch():
        replies = session.get(
            f"{tiles}?since={mirror.complete_to}", consolidation=zenoh.ConsolidationMode.NONE, timeout=10.0
        )
        mirror.fetched([take(reply.ok) for reply in replies if reply.ok is not None])

    return session.declare_subscriber(tiles, take), fetch


if __name__ == "__main__":
    with connect(sys.argv[1]) as session:
        mirror = MapMirror()
        subscriber, fetch = follow(session, sys.argv[2], mirror)
        while True:
            fetch()
            occupied = sum(int((mirror.cells(key) > 65).sum()) for key in list(mirror.tiles))
            print(f"{len(mirror.tiles)} tiles to version {mirror.complete_to}, {occupied} cells occupied")
            time.sleep(5.0)
