"""YAML blocks: whole configs, parts of one in a whole one, and files of faults."""

import pytest
import yaml

from service.config import parse_config
from simulators.fault_file import parse_faults
from tests.docs.blocks import written_in
from tests.simulators.test_fault_file import DEVICES

YAML = written_in("yaml")
WHOLE = {
    "vehicle": "veh1",
    "sensors": {
        "front": {"type": "sick_lms100", "host": "192.168.0.1"},
        "base": {"type": "irobot_create", "device": "/dev/corridor/create"},
    },
    "recording": {"directory": "sessions"},
    "map": {"directory": "maps"},
}


@pytest.mark.parametrize("block", YAML, ids=map(str, YAML))
def test_a_config_or_a_part_of_one_is_accepted(block):
    part = yaml.safe_load(block.text)
    if "faults" in part:
        assert parse_faults(block.text, str(block), DEVICES)
    elif "vehicle" in part:
        parse_config(block.text, str(block))
    else:
        parse_config(yaml.safe_dump(WHOLE | part), str(block))
