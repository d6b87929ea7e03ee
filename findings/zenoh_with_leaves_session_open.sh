#!/usr/bin/env bash
# eclipse-zenoh 1.10.2 (Python), `with zenoh.open(...)`: not closed at the end while another thread uses it.
#
# Expected: the session is closed at the end of the block, as by close(), which may be called meanwhile.
# Found: RuntimeError "Already borrowed" while another thread is in a call of the session, put() here; the
# session stays open.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check eclipse-zenoh==1.10.2

"$work/venv/bin/python" - > "$work/found" <<'PYTHON'
import json
import threading
from importlib.metadata import version

import zenoh

print("eclipse-zenoh", version("eclipse-zenoh"))


def open_session():
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "listen/endpoints": ["tcp/127.0.0.1:0"],
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def end_while_a_thread_puts(session, end):
    in_put, go_on = threading.Event(), threading.Event()

    def take(sample):  # called by put(), in its thread
        in_put.set()
        go_on.wait(20.0)

    session.declare_subscriber("map/tile", zenoh.handlers.Callback(take, indirect=False))
    putting = threading.Thread(target=session.put, args=("map/tile", b"x"))
    putting.start()
    in_put.wait(20.0)
    ending = threading.Thread(target=end, args=(session,))  # close() waits for the callback
    ending.start()
    ending.join(1.0)
    go_on.set()
    ending.join(20.0)
    putting.join(20.0)


def leave_the_block(session):
    try:
        with session:
            pass
    except RuntimeError as error:
        print("with: RuntimeError:", error)


for name, end in {"with": leave_the_block, "close()": zenoh.Session.close}.items():
    session = open_session()
    end_while_a_thread_puts(session, end)
    print(name, "closed:", session.is_closed())
    session.close()
PYTHON
cat "$work/found"
diff - "$work/found" <<'END' || { echo "zenoh ends the block of a session in another manner now"; exit 1; }
eclipse-zenoh 1.10.2
with: RuntimeError: Already borrowed
with closed: False
close() closed: True
END
