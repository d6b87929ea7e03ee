#!/usr/bin/env bash
# numba 0.68.1, njit(cache=True): two processes that compile one function for different types at the same time
# leave a cache in which the index names the code of one for the types of the other.
#
# Expected: the worst of such a race is that one of the two is compiled again.
# Found: every later call for those types raises TypeError, in new processes too, until the cache is deleted.
#        Each process numbers its file after those in the index that it has read, and no lock keeps the other out.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check numba==0.68.1 numpy==2.4.6

cd "$work"
mkdir functions
for number in $(seq 200); do
    printf 'from numba import njit\n@njit(cache=True)\ndef first(a):\n    return a[0]\n' > "functions/of_$number.py"
done
cat > race.py <<'PYTHON'
import multiprocessing as mp
from importlib import import_module
from importlib.metadata import version

import numpy as np

TYPES = np.float32, np.float64


def compile_all(dtype, barrier):
    for number in range(1, 201):
        first = import_module(f"functions.of_{number}").first
        barrier.wait()
        first(np.zeros(1, dtype))


def call_all(found):
    for number in range(1, 201):
        for dtype in TYPES:
            try:
                import_module(f"functions.of_{number}").first(np.zeros(1, dtype))
            except TypeError as error:
                found.add(str(error).split(".")[0])


if __name__ == "__main__":
    context = mp.get_context("spawn")
    barrier = context.Barrier(2)
    both = [context.Process(target=compile_all, args=(dtype, barrier)) for dtype in TYPES]
    for process in both:
        process.start()
    for process in both:
        process.join()
    call_all(found := set())
    print("numba", version("numba"))
    print("calls of what two processes compiled at the same time:", *found or ["all right"])
PYTHON
"$work/venv/bin/python" race.py > found
cat found
diff - found <<'END' || { echo "numba keeps both now, or the result is another one"; exit 1; }
numba 0.68.1
calls of what two processes compiled at the same time: can't unbox array from PyObject into native value
END
