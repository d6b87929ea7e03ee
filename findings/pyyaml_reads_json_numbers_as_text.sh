#!/usr/bin/env bash
# PyYAML 6.0.4, safe_load: numbers that Python's json writes come back as text where they have an exponent and no point.
#
# Expected: the same numbers: JSON is a part of YAML 1.2, and each of these is a JSON number.
# Found: 1e-07 and 1e+16 stay text, for PyYAML, which reads YAML 1.1, wants a point ahead of the exponent.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check PyYAML==6.0.4

"$work/venv/bin/python" - "$work" > "$work/found" <<'PYTHON'
import json
from importlib.metadata import version

import yaml

print("PyYAML", version("PyYAML"))
for number in (0.0001, 2.5e-05, 1e-07, 1e16, 1.5e300):
    text = json.dumps(number)
    print(text, "->", repr(yaml.safe_load(text)))
PYTHON
cat "$work/found"
diff - "$work/found" <<'END' || { echo "PyYAML reads these numbers in another manner now"; exit 1; }
PyYAML 6.0.4
0.0001 -> 0.0001
2.5e-05 -> 2.5e-05
1e-07 -> '1e-07'
1e+16 -> '1e+16'
1.5e+300 -> 1.5e+300
END
