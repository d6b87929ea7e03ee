#!/bin/sh
# pytest 9.2.0: all tests pass, and the session fails, because an old folder for files could not be removed.
#
# Expected: with warnings as errors, a session whose tests pass ends with 0, or names the folder and the reason.
# Found: it ends with 1 and blames an unclosed scandir iterator of pytest's own. A program left over from an earlier
#   session, which still writes to its tmp_path, suffices; so does a second session that cleans at the same time.
set -eu
work=$(mktemp -d)
writer=
trap '[ -z "$writer" ] || kill "$writer"; wait; rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check pytest==9.2.0

mkdir "$work/tests" "$work/files"
printf '[pytest]\nfilterwarnings = error\n' > "$work/tests/pytest.ini"
printf 'def test_passes(tmp_path):\n    assert tmp_path.exists()\n' > "$work/tests/test_passes.py"
cd "$work/tests"
run() { PYTEST_DEBUG_TEMPROOT="$work/files" "$work/venv/bin/python" -m pytest -q -p no:cacheprovider > "$work/log" 2>&1; }
for _ in 1 2 3; do run; done # of which pytest keeps the files; a fourth session removes those of the first

cat > "$work/writer.py" <<'PYTHON'
import itertools
import os
import sys
import time

os.chdir(sys.argv[1])  # where it goes on writing when pytest has renamed the folder
print("writes", flush=True)
begun_s = time.monotonic()
for k in itertools.takewhile(lambda _: time.monotonic() - begun_s < 30.0, itertools.count()):
    open(f"{k % 5000}.log", "w").close()
PYTHON
mkfifo "$work/begun"
"$work/venv/bin/python" "$work/writer.py" "$work/files"/pytest-of-*/pytest-0 > "$work/begun" &
writer=$!
read -r _ < "$work/begun"
code=0
run || code=$?
{
    "$work/venv/bin/pip" list 2> /dev/null | grep '^pytest ' | tr -s ' '
    grep -q '^FAILED\|^ERROR' "$work/log" || echo "no test failed"
    echo "exit code $code"
    grep -q 'unclosed scandir iterator' "$work/log" && echo "blamed: an unclosed scandir iterator"
    grep -q 'pytest-0' "$work/log" && echo "named: the folder" || echo "named: not the folder"
} > "$work/found"
cat "$work/found"
diff - "$work/found" <<'END' || { echo "pytest ends such a session in another manner now"; exit 1; }
pytest 9.2.0
no test failed
exit code 1
blamed: an unclosed scandir iterator
named: not the folder
END
