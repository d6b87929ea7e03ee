#!/usr/bin/env bash
# aiohttp 3.14.5, ClientSession: a connection with data that the server has not taken outlives its session.
#
# Expected: after `async with ClientSession()` all of its connections are closed, for it waits for them at its end.
# Found: one whose request was given up while its body was being sent is open still, and asyncio.run ends before it.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check aiohttp==3.14.5

"$work/venv/bin/python" - > "$work/found" <<'PYTHON'
import asyncio
import gc
import io
import socket
import warnings
from importlib.metadata import version

import aiohttp

print("aiohttp", version("aiohttp"))
server = socket.create_server(("127.0.0.1", 0))  # takes connections and reads nothing
url = f"http://127.0.0.1:{server.getsockname()[1]}/"


async def give_up() -> None:
    async with aiohttp.ClientSession() as session:
        try:
            await asyncio.wait_for(session.post(url, data=io.BytesIO(bytes(60_000_000))), 1.0)
        except asyncio.TimeoutError:
            print("given up after a second")
    print("session closed:", session.closed)


with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always", ResourceWarning)
    asyncio.run(give_up())
    gc.collect()
print(sorted({str(one.message).split(" ")[1].strip("<") for one in caught if "unclosed" in str(one.message)}))
PYTHON
cat "$work/found"
diff - "$work/found" <<'END' || { echo "aiohttp closes these connections now"; exit 1; }
aiohttp 3.14.5
given up after a second
session closed: True
['socket.socket', 'transport']
END
