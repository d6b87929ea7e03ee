"""Kernels before and after numba is imported, in processes that begin without it."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]

BEGIN = """
import math, sys
import numpy as np
from service.kernels import linear3, se2, usual_gap
from service.compile.lazy import WaitingKernel, njit
from service.kernels.usual_gap import usual_gap as by_name
by_key = {"gap": by_name}
assert "numba" not in sys.modules
assert isinstance(by_name, WaitingKernel)
"""


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", BEGIN + code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_first_call_imports_numba_and_puts_its_kernels_into_every_module_and_into_later_ones():
    assert run("""
gap = by_key["gap"](np.array([0, 2, 4, 6, 7], np.int32))
from numba.core.dispatcher import Dispatcher
kernels = [v for m in (linear3, se2, usual_gap) for v in vars(m).values() if hasattr(v, "py_func")]
assert kernels and all(isinstance(kernel, Dispatcher) for kernel in kernels)
assert not any(isinstance(v, WaitingKernel) for m in list(sys.modules.values()) for k, v in vars(m).items()
               if m.__name__.startswith("service"))
assert usual_gap.usual_gap.signatures and by_key["gap"](np.array([0, 3], np.int32)) == 3
print(gap)
from service.kernels import maximum_likelihood_pose as by_maximum  # waits for nothing
assert isinstance(by_maximum.copy_vector, Dispatcher) and isinstance(by_maximum.hill_climb, Dispatcher)
assert by_maximum.copy_vector is linear3.copy_vector
""").split() == ["2"]


def test_the_kernels_of_a_profile_are_found_before_any_is_called():
    assert "match_scan" in run("""
from service.mapper.profiles import mapping_config
mapping_config({"profile": "corridor"})
assert "numba" not in sys.modules
from service.compile.signatures import jobs_of_process
print(*(job.name for job in jobs_of_process()[0]))
""")


def test_no_kernel_takes_njit_from_numba_itself():
    """It could not call those that wait."""
    kernels = [path for package in ("service", "simulators") for path in (ROOT / package).rglob("*.py")]
    theirs = re.compile(r"^from numba import .*\bn?jit\b", re.MULTILINE)
    assert [str(path) for path in kernels if theirs.search(path.read_text(encoding="utf-8"))] == []
