import subprocess
import sys

import pytest

from drivers.registry import SENSOR_KINDS


def test_a_type_brings_its_own_modules_and_no_other_s():
    code = """
import sys
from drivers.registry import SENSOR_KINDS
assert "ibeo_lux" in SENSOR_KINDS and len(SENSOR_KINDS) >= 5
SENSOR_KINDS["sick_lms100"]
print(*(name for name in SENSOR_KINDS if f"drivers.{name}" in sys.modules))
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["sick_lms100"]


def test_a_kind_is_made_once():
    assert SENSOR_KINDS["xsens_mtig"] is SENSOR_KINDS["xsens_mtig"]


def test_an_unknown_type_is_a_key_error():
    assert "nothing" not in SENSOR_KINDS
    assert SENSOR_KINDS.get("nothing") is None
    with pytest.raises(KeyError):
        SENSOR_KINDS["nothing"]


@pytest.mark.parametrize("name", list(SENSOR_KINDS))
def test_each_type_says_its_own_name(name: str):
    assert SENSOR_KINDS[name].config.model_fields["type"].default == name
