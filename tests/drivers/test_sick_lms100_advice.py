import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.sick_lms100.advice import ADVICE
from drivers.sick_lms100.protocol import Dialect, Telegram, encode
from tests.drivers.lms100 import config


@pytest.mark.parametrize("dialect", list(Dialect))
def test_a_scanner_is_known_by_a_telegram_of_either_dialect(dialect: Dialect):
    answer = encode(Telegram(dialect, "sRA", "SCdevicestate", b"1"))
    assert ADVICE.recognise(b"noise" + answer) == f"a SICK scanner that speaks {dialect.value}"


@given(st.binary(max_size=16_384))
def test_any_bytes_can_be_judged(data: bytes):
    assert isinstance(ADVICE.recognise(data), str)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"dialect": "cola_a", "port": 2111}, ["dialect: cola_b", "port: 2112"]),
        ({"dialect": "cola_b", "port": 4000}, ["dialect: cola_a"]),
        ({"dialect": "auto", "port": 2112}, ["port: 2111"]),
        ({"dialect": "auto", "port": 4000}, []),
    ],
)
def test_other_settings_are_those_that_explain_silence(changes: dict[str, object], words: list[str]):
    tried = ADVICE.other_settings(config(**changes))
    assert [other.words for other in tried] == words
    for other in tried:
        key, _, value = other.words.partition(": ")
        assert str(getattr(other.config, key)) == value


def test_another_family_of_scanners_is_questioned():
    assert ADVICE.doubt(config(), {"device": "LMS10x_FieldEval"}) == ""
    assert ADVICE.doubt(config(), {}) == ""
    assert "it calls itself TiM551" in ADVICE.doubt(config(), {"device": "TiM551"})
