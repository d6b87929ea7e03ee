#!/bin/sh
# rosbags 0.11.9 opens a db3 as an immutable file: rows in its write-ahead log are not read, without a word.
# Expected: the rows that every SQLite program sees, 2, or an error. Output: 1 row of 2.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q rosbags==0.11.9
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import importlib.metadata
import os
import shutil
import sqlite3
import sys
from pathlib import Path

from rosbags.rosbag2 import Reader, Writer
from rosbags.typesys import Stores, get_typestore

folder = Path(sys.argv[1])
store = get_typestore(Stores.ROS2_HUMBLE)
text = store.types["std_msgs/msg/String"]
with Writer(folder / "bag", version=9) as writer:
    topic = writer.add_connection("/words", "std_msgs/msg/String", typestore=store)
    writer.write(topic, 1, store.serialize_cdr(text("first"), "std_msgs/msg/String"))
(path,) = (folder / "bag").glob("*.db3")
recorder = sqlite3.connect(path)  # as rosbag2 with the preset "resilient"
recorder.execute("PRAGMA journal_mode=WAL")
recorder.execute("INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, 2, data FROM messages")
recorder.commit()
killed = folder / "killed"  # what is on the disk when the recorder is killed
killed.mkdir()
for file in path.parent.glob("*.db3*"):
    shutil.copy(file, killed)
with Reader(killed / path.name) as reader:
    by_rosbags = sum(1 for _ in reader.messages())
by_sqlite = sqlite3.connect(killed / path.name).execute("SELECT count(*) FROM messages").fetchone()[0]
print(f"rosbags {importlib.metadata.version('rosbags')}: rows by rosbags: {by_rosbags}; by SQLite: {by_sqlite}")
sys.stdout.flush()
os._exit(0 if (by_rosbags, by_sqlite) == (1, 2) else 1)
PYTHON
