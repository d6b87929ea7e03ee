import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.irobot_create.driver import STREAM_IDS
from drivers.irobot_create.protocol import encode_frame
from drivers.sick_lms100.protocol import Dialect, Telegram, encode
from service.offline.doctor.protocol_identification import describe, recognise_sensor


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"HTTP/1.1 400 Bad Request\r\nServer: x\r\n", 'a web server ("HTTP/1.1 400 Bad Request")'),
        (b"SSH-2.0-OpenSSH_9.2\r\n", 'an SSH server ("SSH-2.0-OpenSSH_9.2")'),
        (b"220 printer FTP ready\r\n", "an FTP or mail server"),
        (b"\xff\xfd\x18\xff\xfd\x20", "a telnet server"),
        (b"\x15\x03\x03\x00\x02\x02\x46", "a server that wants TLS"),
        (b"x\r\n$GPGGA,123519,4807.038,N\r\n", "a GNSS receiver"),
        (b"ATE1\r", "ModemManager"),
        (b"hello, who is there?\n", 'text that begins "hello, who is there?"'),
        (b"\x00" * 40, "all the same"),
        (bytes([0x00, 0xFE, 0xF8, 0x80, 0x33]) * 20, "at the wrong baud rate"),
        (bytes(range(256)), "no message of any sensor known here"),
    ],
)
def test_bytes_are_reported_in_words(data: bytes, words: str):
    assert words in describe(data)


def test_sensors_know_each_other_by_their_bytes():
    telegram = encode(Telegram(Dialect.BINARY, "sAN", "Run", b"\x01"))
    assert describe(b"\x00\x13" + telegram) == "a SICK scanner that speaks CoLa-B"
    frames = encode_frame(STREAM_IDS, dict.fromkeys(STREAM_IDS, 0)) * 3
    assert recognise_sensor(frames, "irobot_create") == "an iRobot Create or Roomba"
    assert recognise_sensor(frames, "sick_lms100") == ""


@given(st.binary(min_size=1, max_size=16_384))
def test_any_bytes_can_be_named(data: bytes):
    assert describe(data).isprintable()
