#!/usr/bin/env bash
# mcap 1.6.0 (Python), make_reader: a damaged chunk is read without a word, although its CRC in the file says so.
#
# Expected: an error for a file with one flipped byte: the writer puts a CRC beside each chunk by default.
# Found: the altered message, unless validate_crcs=True is given.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check mcap==1.6.0

"$work/venv/bin/python" - "$work" > "$work/found" <<'PYTHON'
import io
from importlib.metadata import version

from mcap.stream_reader import CRCValidationError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

print("mcap", version("mcap"))
file = io.BytesIO()
writer = Writer(file, compression=CompressionType.NONE)
writer.start()
schema = writer.register_schema("speed", "jsonschema", b"{}")
channel = writer.register_channel("/speed", "json", schema)
writer.add_message(channel, log_time=1, data=b"1.25 m/s", publish_time=1)
writer.finish()
damaged = file.getvalue().replace(b"1.25 m/s", b"9.25 m/s", 1)
for options in ({}, {"validate_crcs": True}):
    try:
        read = [message.data for _, _, message in make_reader(io.BytesIO(damaged), **options).iter_messages()]
        print(options, read)
    except CRCValidationError:
        print(options, "CRCValidationError")
PYTHON
cat "$work/found"
diff - "$work/found" <<'END' || { echo "mcap checks CRCs in another manner now"; exit 1; }
mcap 1.6.0
{} [b'9.25 m/s']
{'validate_crcs': True} CRCValidationError
END
