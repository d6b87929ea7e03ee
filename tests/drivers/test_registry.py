import subprocess
import sys

import pytest

from drivers.lazy_registry import LazyRegistry
from drivers.registry import SENSOR_KINDS


def test_a_module_is_imported_when_its_name_is_asked_for():
    code = """
import sys
from drivers.lazy_registry import LazyRegistry
from drivers.sensor_kind import SensorKind
kinds = LazyRegistry(SensorKind, {"base": "drivers.irobot_create.kind"})
assert list(kinds) == ["base"] and "base" in kinds and len(kinds) == 1
assert "drivers.irobot_create" not in sys.modules
print(kinds["base"].config.__name__, "drivers.irobot_create" in sys.modules)
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["IrobotCreateConfig", "True"]


def test_a_kind_of_another_type_is_refused():
    kinds = LazyRegistry(dict, {"front": "drivers.sick_lms100.kind"})
    with pytest.raises(TypeError, match=r"sick_lms100\.kind\.KIND is a SensorKind, expected a dict"):
        kinds["front"]


@pytest.mark.parametrize("name", list(SENSOR_KINDS))
def test_each_type_says_its_own_name(name: str):
    assert SENSOR_KINDS[name].config.model_fields["type"].default == name
