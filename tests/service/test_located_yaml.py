import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from service.located_yaml import MAX_VALUES, Position, load
from tests.soaked import examples


def faults(text: str) -> list[str]:
    return [fault.text("f.yaml") for fault in load(text).faults]


@pytest.mark.parametrize(
    ("value", "diagnostic"),
    [
        ("no", 'YAML takes no for false; write false, or quote it: "no"'),
        ("On", 'YAML takes On for true; write true, or quote it: "On"'),
        ("012", 'YAML takes 012 for octal; write 12, or quote it: "012"'),
        ("-07", 'YAML takes -07 for octal; write 7, or quote it: "-07"'),
        ("1:30", 'YAML takes 1:30 for a base-60 number; quote it: "1:30"'),
        ("1e3", "YAML takes 1e3 for text; write 1000.0, or quote it"),
        ("2.5e-3", "2.5e-3"),  # a float in YAML 1.1 too: taken
        ("25e-4", "YAML takes 25e-4 for text; write 0.0025, or quote it"),
        ("1_000", 'write 1000, or quote it: "1_000"'),
        ("0b11", 'write 3, or quote it: "0b11"'),
        ("0x10", 'write 16, or quote it: "0x10"'),
        ("-0x1F", 'write -31, or quote it: "-0x1F"'),
        ("0o17", "YAML takes 0o17 for text; write 15, or quote it"),
        ("2024-05-01", 'YAML takes 2024-05-01 for a date; quote it: "2024-05-01"'),
        (".inf", ".inf is not a finite number in plain decimals"),
        ("1:30.5", "1:30.5 is not a finite number in plain decimals"),
        (
            "!!python/name:os.system x",
            "tags such as tag:yaml.org,2002:python/name:os.system are not read here",
        ),
    ],
)
def test_surprises_of_yaml_are_faults_with_advice(value: str, diagnostic: str):
    if diagnostic == value:
        assert load(f"a: {value}").value == {"a": float(value)}
    else:
        assert faults(f"a: {value}") == [f"f.yaml:1:4: a: {diagnostic}"]


def test_what_is_quoted_is_text():
    assert load('a: "no"\nb: \'012\'\nc: "1:30"\nd: "1e3"').value == {
        "a": "no",
        "b": "012",
        "c": "1:30",
        "d": "1e3",
    }


def test_plain_values_have_their_plain_meaning():
    document = load("a: -3\nb: 16\nc: 2.5\nd: true\ne:\nf: tcp/127.0.0.1:7447\ng: [1, {x: y}]\n")
    expected = {
        "a": -3,
        "b": 16,
        "c": 2.5,
        "d": True,
        "e": None,
        "f": "tcp/127.0.0.1:7447",
        "g": [1, {"x": "y"}],
    }
    assert document.value == expected
    assert not document.faults


def test_a_key_twice_is_refused_and_says_where_it_stood():
    assert faults("a: 1\nb:\n  c: 1\n  c: 2\n") == [
        "f.yaml:4:3: b.c: this key stands already at 3:3; keep one of them"
    ]


def test_every_fault_is_listed():
    assert len(faults("a: no\nb: 012\na: 3\n")) == 3


def test_positions_are_those_of_the_keys_and_of_list_items():
    document = load("a:\n  b: [1,\n      2]\n")
    assert document.position(("a", "b")) == Position(2, 3)
    assert document.position(("a", "b", 1)) == Position(3, 7)
    assert document.position(("a", "missing", "below")) == Position(1, 1)


@pytest.mark.parametrize("text", ["a: [1,\nb: 2", "a: \x00", "a: 1\n---\nb: 2", "a: *nothing", "\ta: 1"])
def test_what_is_not_yaml_is_one_fault_with_a_place(text: str):
    (fault,) = faults(text)
    assert "not YAML: " in fault


def test_merge_keys_and_odd_keys_are_refused():
    assert faults("<<: {a: 1}\n") == ["f.yaml:1:1: <<: merge keys are not read here; write the keys out"]
    assert faults("[1, 2]: 3\n") == ["f.yaml:1:1: a key must be a single word"]


def test_an_alias_inside_itself_ends():
    assert any("nested deeper than 20 levels" in fault for fault in faults("a: &a [*a]"))


def test_aliases_that_multiply_end():
    doubling = "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 19))
    assert faults("a0: &a0 [1, 1]\n" + doubling) == [
        f"f.yaml:1:5: more than {MAX_VALUES} values; aliases of aliases?"
    ]


def test_an_empty_document_is_nothing():
    assert load("").value is None
    assert load("# only a comment\n").faults == []


words = st.text("ab1:_. -#'", max_size=6)
leaves = st.none() | st.booleans() | st.integers(-(10**9), 10**9) | words
trees = leaves | st.lists(leaves, max_size=3) | st.dictionaries(words, leaves, max_size=3)


@given(st.dictionaries(words, trees, max_size=4))
def test_what_pyyaml_writes_is_read_back_or_refused(tree: dict[str, object]):
    document = load(yaml.safe_dump(tree))
    assert document.value == tree or document.faults


@settings(max_examples=examples(20))
@given(st.text(max_size=40))
def test_any_text_is_read_without_an_exception(text: str):
    for fault in load(text).faults:
        assert 1 <= fault.position.line <= len(text) + 1
