"""docs/constants.md is what the code has, and every number that is measured or chosen says what it is."""

import re

from tests.docs.constants import PAGE, constants_by_file, page

COUNT_OR_CODE = re.compile(
    r"-?\d+|[A-Z_0-9 <+*-]+|(range|slice|np\.empty|Grid|\w*Config|\w*Settings|frozenset)\(.*"
)


def test_the_page_of_constants_is_that_of_the_code():
    assert PAGE.read_text() == page(), "run: .venv/bin/python -m tests.docs.constants"


def test_each_constant_of_the_mapper_that_is_no_count_has_its_meaning_beside_it():
    missing = [
        f"{file}: {one.name} = {one.value}"
        for file, constants in constants_by_file().items()
        for one in constants
        if not one.meaning and not COUNT_OR_CODE.fullmatch(one.value)
    ]
    assert not missing


def test_a_name_has_one_value_in_the_whole_mapper():
    values: dict[str, set[str]] = {}
    for constants in constants_by_file().values():
        for one in constants:
            values.setdefault(one.name, set()).add(one.value)
    assert [name for name, different in values.items() if len(different) > 1] == []
