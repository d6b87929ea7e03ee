#!/bin/sh
# gtsam 4.3.0, readG2o of a 2-D file: a FIX line or a comment ends the reading of edges, without an error.
#
# Expected: one edge from each of these files, as g2o itself reads it; a line of an unknown kind is passed over.
# Found: no edge where FIX or a comment stands above it, and one where FIX stands below.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check \
    gtsam==4.3.0 g2opy==2.3.0 numpy==2.4.6 pytest==9.2.0 # gtsam does not start without pytest

vertices='VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0'
edge='EDGE_SE2 0 1 1 0 0 100 0 0 100 0 400'
printf '%s\n%s\nFIX 0\n' "$vertices" "$edge" > "$work/fix_below.g2o"
printf '%s\nFIX 0\n%s\n' "$vertices" "$edge" > "$work/fix_above.g2o"
printf '%s\n# odometry\n%s\n' "$vertices" "$edge" > "$work/comment_above.g2o"
printf '%s\nUNKNOWN 0 1\n%s\n' "$vertices" "$edge" > "$work/unknown_above.g2o"

"$work/venv/bin/python" - "$work" > "$work/found" <<'PYTHON'
import sys
from importlib.metadata import version

import g2opy
import gtsam

print("gtsam", version("gtsam"), "g2opy", version("g2opy"))
folder = sys.argv[1]
for name in ("fix_below", "fix_above", "comment_above", "unknown_above"):
    optimizer = g2opy.SparseOptimizer()
    optimizer.load(f"{folder}/{name}.g2o")
    factors, values = gtsam.readG2o(f"{folder}/{name}.g2o", False)
    print(f"{name}: {values.size()} poses; edges: g2o {len(optimizer.edges())}, gtsam {factors.size()}")
PYTHON
cat "$work/found"
diff - "$work/found" <<'END' || { echo "gtsam reads these files in another manner now"; exit 1; }
gtsam 4.3.0 g2opy 2.3.0
fix_below: 2 poses; edges: g2o 1, gtsam 1
fix_above: 2 poses; edges: g2o 1, gtsam 0
comment_above: 2 poses; edges: g2o 1, gtsam 0
unknown_above: 2 poses; edges: g2o 1, gtsam 1
END
