"""The program of docs/commands.md does what the page says."""

import ast
import re
from pathlib import Path

import pytest

from service.mapper.edit_requests import EDIT_MAP
from service.mapper.graph.loops.live_edits import MAX_UNDONE
from service.publishing.commands import CommandDispatcher, Outcome, Request, Verb
from service.publishing.zenoh_publisher import ZenohPublisher

PAGE = Path(__file__).parents[3] / "docs" / "commands.md"


class Mark(Request):
    text: str


def test_the_program_prints_the_answer_and_the_error(
    publisher: ZenohPublisher, capsys: pytest.CaptureFixture[str]
):
    def mark(request: Mark, outcome: Outcome) -> None:
        assert request.text == "door open"
        outcome.done(log_ns=1795256101483012467)

    publisher.answer_commands(CommandDispatcher({"mark": Verb(Mark, mark)}).answer)
    text = PAGE.read_text(encoding="utf-8")
    program = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert program is not None
    here = program[1].replace("tcp/127.0.0.1:7447", publisher.endpoints[0])
    exec(compile(here, str(PAGE), "exec"), {})
    exec(compile(here.replace('{"text": "door open"}', "{}"), str(PAGE), "exec"), {})
    answer, error = capsys.readouterr().out.splitlines()
    assert f"`{answer}`" in text
    assert f"`{ast.literal_eval(error)['error']}`" in text


def test_each_change_of_edit_map_has_an_example_that_is_taken():
    section = PAGE.read_text(encoding="utf-8").split("## edit_map")[1]
    examples = dict(re.findall(r"^\| `([a-z-]+)` \|.*`({.*})` \|$", section, re.MULTILINE))
    for what, example in examples.items():
        assert EDIT_MAP.validate_json(f'{{"change": {example}}}').change.what == what
    assert (
        examples.keys() == EDIT_MAP.json_schema()["properties"]["change"]["discriminator"]["mapping"].keys()
    )
    assert f"up to {MAX_UNDONE}" in section
