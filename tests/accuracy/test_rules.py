"""What the tables of single rules switch off is there: a name that has moved would end a bench of an hour."""

from typing import Any
from unittest.mock import patch

import pytest

from tests.accuracy import ablations, loop_rules, rules

SWITCHED: list[tuple[str, str, dict[str, Any]]] = [
    *rules.RULES,
    *((rule.what, rule.module, rule.off) for rule in loop_rules.RULES),
    *(
        (what, module, constants)
        for what, settings in ablations.PARTS
        for module, constants in (settings or {}).items()
        if "." in module
    ),
]


@pytest.mark.parametrize(("what", "module", "off"), [each for each in SWITCHED if each[2]])
def test_what_a_rule_switches_off_is_there(what: str, module: str, off: dict[str, Any]):
    with patch.multiple(module, **off):
        pass
