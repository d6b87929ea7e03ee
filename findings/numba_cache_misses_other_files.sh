#!/usr/bin/env bash
# numba 0.68.1, njit(cache=True): after a change of a function in another file the old machine code goes on.
#
# Expected: the new result: the cache is there to be rebuilt where a source has changed.
# Found: the old one, for the cache looks at the file of the outer function alone.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check numba==0.68.1 numpy==2.4.6

"$work/venv/bin/python" - "$work" > "$work/found" <<'PYTHON'
import os
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

print("numba", version("numba"))
folder = Path(sys.argv[1])
outer = "from numba import njit\nimport inner\n@njit(cache=True)\ndef twice(x):\n    return 2 * inner.scaled(x)\n"
(folder / "outer.py").write_text(outer + "print('twice(1) =', twice(1))\n")
inner = "from numba import njit\n@njit(cache=True)\ndef scaled(x):\n    return {} * x\n"
for nanoseconds, factor in ((1, 10), (2, 50)):
    path = folder / "inner.py"
    path.write_text(inner.format(factor))
    os.utime(path, ns=(nanoseconds * 10**12, nanoseconds * 10**12))  # a time of its own for each
    done = subprocess.run([sys.executable, "outer.py"], cwd=folder, capture_output=True, text=True, check=True)
    print("scaled(x) is", factor, "* x:", done.stdout.strip())
PYTHON
cat "$work/found"
diff - "$work/found" <<'END' || { echo "numba sees changes of other files now, or the result is another one"; exit 1; }
numba 0.68.1
scaled(x) is 10 * x: twice(1) = 20
scaled(x) is 50 * x: twice(1) = 20
END
