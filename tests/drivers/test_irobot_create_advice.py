import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.irobot_create.advice import ADVICE
from drivers.irobot_create.driver import STREAM_IDS
from drivers.irobot_create.protocol import encode_frame
from tests.drivers.irobot_bench import CONFIG, CREATE1

FRAME = encode_frame(STREAM_IDS, dict.fromkeys(STREAM_IDS, 0))


def test_a_robot_is_known_by_its_stream_or_its_banner_but_not_by_chance():
    assert ADVICE.recognise(FRAME[5:] + FRAME * 2) == "an iRobot Create or Roomba"
    assert ADVICE.recognise(b"bl-start\r\nSTR730\r\nbootloader id: #x47186549 82ECCFFF\r\n") != ""
    assert ADVICE.recognise(FRAME) == ""


@given(st.binary(max_size=16_384))
def test_any_bytes_can_be_judged(data: bytes):
    assert isinstance(ADVICE.recognise(data), str)


def test_the_rate_is_that_of_the_model():
    assert ADVICE.rate_hz(CONFIG) == pytest.approx(66.67, abs=0.01)
    assert ADVICE.rate_hz(CREATE1) == pytest.approx(10.0)
