#!/usr/bin/env bash
# eclipse-zenoh 1.10.2 (Python), Publisher.matching_status: true in every `if`, though no client subscribes.
#
# Expected: a bool, as zenoh's type stub declares: False without a subscriber.
# Found: an object of no declared truth value, so always true; its attribute `matching` has the answer.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check eclipse-zenoh==1.10.2

"$work/venv/bin/python" - "$work" > "$work/found" <<'PYTHON'
import json
from importlib.metadata import version

import zenoh

print("eclipse-zenoh", version("eclipse-zenoh"))
config = zenoh.Config()
for key, value in {
    "mode": "peer",
    "listen/endpoints": ["tcp/127.0.0.1:0"],
    "scouting/multicast/enabled": False,
}.items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config) as session:
    status = session.declare_publisher("map/tile").matching_status
    print(type(status).__name__, "bool", bool(status), "matching", status.matching)
PYTHON
cat "$work/found"
diff - "$work/found" <<'END' || { echo "zenoh tells of matching subscribers in another manner now"; exit 1; }
eclipse-zenoh 1.10.2
MatchingStatus bool True matching False
END
