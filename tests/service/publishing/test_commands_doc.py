"""The program of docs/commands.md does what the page says."""

import re
from pathlib import Path

from service.mapper.edit_requests import EDIT_MAP
from service.mapper.graph.loops.live_edits import MAX_UNDONE

PAGE = Path(__file__).parents[3] / "docs" / "commands.md"


def test_each_change_of_edit_map_has_an_example_that_is_taken():
    section = PAGE.read_text(encoding="utf-8").split("## edit_map")[1]
    examples = dict(re.findall(r"^\| `([a-z-]+)` \|.*`({.*})` \|$", section, re.MULTILINE))
    for what, example in examples.items():
        assert EDIT_MAP.validate_json(f'{{"change": {example}}}').change.what == what
    assert (
        examples.keys() == EDIT_MAP.json_schema()["properties"]["change"]["discriminator"]["mapping"].keys()
    )
    assert f"up to {MAX_UNDONE}" in section
