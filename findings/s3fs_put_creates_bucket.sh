#!/bin/sh
# s3fs 2026.9.0: a folder put into a bucket that is not there makes the bucket; a single file does not.
#
# Expected: both raise FileNotFoundError, so that a mistyped bucket is noticed.
# Found: put_file() raises, put(recursive=True) makes the bucket and the objects in it.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check s3fs==2026.9.0 fsspec==2026.9.0 "moto[s3,server]==5.2.5"

cat > "$work/put.py" <<'PYTHON'
import logging
import os

import s3fs
from moto.server import ThreadedMotoServer

logging.getLogger("werkzeug").setLevel(logging.ERROR)
os.environ |= {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_DEFAULT_REGION": "us-east-1"}
server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
server.start()
host, port = server.get_host_and_port()
store = s3fs.S3FileSystem(endpoint_url=f"http://{host}:{port}")
os.makedirs("result")
with open("result/summary.json", "w") as file:
    file.write("{}")
print("s3fs", s3fs.__version__)
try:
    store.put_file("result/summary.json", "mistyped/result/summary.json")
    print("a file: written")
except FileNotFoundError:
    print("a file: FileNotFoundError")
try:
    store.put("result/", "mistyped/result/", recursive=True)
    print("a folder: written, buckets", store.ls("/", refresh=True))
except FileNotFoundError:
    print("a folder: FileNotFoundError")
server.stop()
PYTHON

cd "$work"
venv/bin/python put.py > found
cat found
diff - found <<'END' || { echo "s3fs treats a bucket that is not there in another manner now"; exit 1; }
s3fs 2026.9.0
a file: FileNotFoundError
a folder: written, buckets ['mistyped']
END
