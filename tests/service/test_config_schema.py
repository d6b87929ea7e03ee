import json
from pathlib import Path

import jsonschema
import pytest
import yaml

from service.cli import main
from service.config_schema import schema_text
from service.errors import UsageError
from service.mapper.profiles import METHODS

CONFIG = Path(__file__).parents[2] / "config"
EXAMPLES = {  # folder -> what each file in it is
    CONFIG: "config",
    CONFIG / "sensors": "sensor",
    CONFIG / "profiles": "mapping",
}
FILES = [path for folder in EXAMPLES for path in sorted(folder.glob("*.yaml"))]
GOOD = {
    "vehicle": "veh1",
    "sensors": {"front": {"type": "sick_lms100", "host": "192.168.0.1"}},
    "recording": {"directory": "s"},
    "map": {"directory": "m"},
}


@pytest.fixture(scope="module")
def schema():
    made = json.loads(schema_text(), parse_constant=pytest.fail)  # NaN is no JSON, and editors refuse it
    jsonschema.Draft202012Validator.check_schema(made)
    return made


def faults(schema, value, what: str = "config") -> list[str]:
    if what != "config":
        schema = {"$defs": schema["$defs"], "$ref": f"#/$defs/{what}"}
    return [error.message for error in jsonschema.Draft202012Validator(schema).iter_errors(value)]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_each_example_keeps_to_the_schema_that_its_first_line_names(schema, path):
    what = EXAMPLES[path.parent]
    assert faults(schema, yaml.safe_load(path.read_text()), what) == []
    relative = f"{'' if path.parent == CONFIG else '../'}schema/{what}.json"
    assert path.read_text().startswith(f"# yaml-language-server: $schema={relative}\n")


@pytest.mark.parametrize("what", ["sensor", "mapping"])
def test_the_schemas_of_parts_refer_to_that_of_the_whole(what):
    part = json.loads((CONFIG / "schema" / f"{what}.json").read_text())
    assert part["$ref"] == f"config.json#/$defs/{what}"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vehicle": "Veh 1"}, "does not match"),
        ({"wheels": {}}, "'wheels' was unexpected"),
        ({"sensors": {}}, "should be non-empty"),
        ({"sensors": {"front": {"type": "sick"}}}, "is not one of"),
        ({"sensors": {"front": {"type": "sick_lms100"}}}, "'host' is a required property"),
        ({"sensors": {"front": {"type": "sick_lms100", "host": "a", "baud": 1}}}, "'baud' was unexpected"),
        ({"mapping": {"profile": "fast"}}, "is not one of"),
        ({"mapping": {"settings": {"matcher": {"x": 1}}}}, "'x' was unexpected"),
        ({"mapping": {"cell_m": 5.0}}, "greater than the maximum"),
        ({"recording": {}}, "'directory' is a required property"),
        ({"web": {"listen": 8080}}, "8080 is not of type 'string'"),
        ({"web": 8080}, "8080 is not of type 'object', 'null'"),
    ],
)
def test_a_fault_is_found(schema, change, words):
    assert faults(schema, GOOD) == []
    found = faults(schema, GOOD | change)
    assert any(words in message for message in found), found


@pytest.mark.parametrize("profile", METHODS)
def test_settings_are_those_of_the_profile(schema, profile):
    assert faults(schema, GOOD | {"mapping": {"profile": profile}}) == []
    wrong = {"mapping": {"profile": profile, "settings": {"no_such_slot": {}}}}
    assert any("'no_such_slot' was unexpected" in message for message in faults(schema, GOOD | wrong))


def test_empty_sections_and_chosen_components_are_right(schema):
    chosen = {"mapping": {"components": {"matcher": "x"}, "settings": {"matcher": {"any": 1}}}, "web": None}
    assert faults(schema, GOOD | chosen) == []


def test_the_command_prints_it_and_takes_no_config_then(schema, capsys):
    assert main(["check", "--schema"]) == 0
    printed = capsys.readouterr().out
    assert json.loads(printed) == schema
    assert '"default": "127.0.0.1:8080"' in printed  # editors show it
    with pytest.raises(SystemExit) as left:
        main(["check", "vehicle.yaml", "--schema"])
    assert left.value.code == UsageError.exit_code
