#!/bin/sh
# fsspec 2026.9.0: a file over HTTP says that it can seek, also from a server that sends no parts of files.
#
# Expected: seekable() is False, or open() refuses, where the server ignores Range.
# Found: open(), seekable(), seek() and tell() all agree; the first read past the start raises.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check "fsspec[http]==2026.9.0" aiohttp==3.13.2

cat > "$work/seek.py" <<'PYTHON'
import http.server
import os
import threading

import fsspec


class Quiet(http.server.SimpleHTTPRequestHandler):  # of the standard library: it knows no Range
    def log_message(self, *arguments):
        pass


with open("recording.bin", "wb") as file:
    file.write(bytes(20_000_000))
server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet)
server.handle_error = lambda *_: None  # the client leaves before the end of the file
threading.Thread(target=server.serve_forever, daemon=True).start()
address = f"http://127.0.0.1:{server.server_port}/recording.bin"
print("fsspec", fsspec.__version__)
with fsspec.open(address, "rb", block_size=1_000_000) as file:
    print("seekable:", file.seekable())
    file.seek(10_000_000)
    print("tell:", file.tell())
    try:
        print("read:", len(file.read(16)), "bytes")
    except ValueError as error:
        print("read:", type(error).__name__)
os._exit(0)
PYTHON
cd "$work"
venv/bin/python -u seek.py > found
cat found
diff - found <<'END' || { echo "fsspec treats such servers in another manner now"; exit 1; }
fsspec 2026.9.0
seekable: True
tell: 10000000
read: ValueError
END
