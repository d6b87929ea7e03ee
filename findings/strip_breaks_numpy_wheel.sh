#!/usr/bin/env bash
# GNU strip 2.40 (Debian 12) on the libraries of the wheel of numpy 2.4.6: they load no more.
#
# Expected: strip takes away symbols that nothing needs at run time, as dh_strip does in each Debian package.
# Found: libraries that auditwheel has patched (ELF segments moved by patchelf) are written at offsets that the
# loader refuses.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6

strip --version | head -n 1
load() {
    { "$work/venv/bin/python" -c "import numpy; print('numpy', numpy.__version__)" 2>&1 || true; } |
        grep -o -m 1 'numpy [0-9.]*$\|ELF load.*'
}
load > "$work/found"
strip --strip-unneeded "$work"/venv/lib/python3*/site-packages/numpy.libs/*.so*
load >> "$work/found"
cat "$work/found"
diff - "$work/found" <<'END' || { echo "a stripped library of numpy loads now"; exit 1; }
numpy 2.4.6
ELF load command address/offset not page-aligned
END
