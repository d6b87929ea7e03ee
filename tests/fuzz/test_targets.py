"""Damaged bytes, by hypothesis; `python -m tests.fuzz` looks further, by coverage."""

import random
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drivers.damage import mutate
from tests.fuzz.targets import TARGETS
from tests.soaked import examples

SOAK_S = 3600.0  # in all
seeds_of = cache(lambda name: TARGETS[name].seeds())


@pytest.mark.parametrize("name", TARGETS)
def test_bytes_that_are_read_well_are_no_reason_to_refuse(name: str):
    """Else damage to them would show nothing."""
    read = [seed for seed in seeds_of(name) if _is_read(name, seed)]
    assert read


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=examples(12))
@given(damage=st.integers(0, 2**32))
def test_damaged_bytes_are_read_or_refused_in_words(name: str, damage: int):
    chance = random.Random(damage)
    TARGETS[name](mutate(chance.choice(seeds_of(name)), chance))


@pytest.mark.soak
@pytest.mark.timeout(2 * SOAK_S)
@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.skipif(sys.version_info >= (3, 13), reason="atheris has no wheel for this Python")
def test_an_hour_of_search_by_coverage_finds_nothing(name: str, tmp_path: Path):
    command = [sys.executable, "-m", "tests.fuzz", name, "--seconds", str(SOAK_S / len(TARGETS))]
    done = subprocess.run([*command, "--found", str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]


def _is_read(name: str, seed: bytes) -> bool:
    target = TARGETS[name]
    try:
        target.run(seed)
    except target.refusals:
        return False
    return True
