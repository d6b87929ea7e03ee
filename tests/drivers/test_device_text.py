"""Texts of devices: shown as they are where they are plain, harmless where not."""

import pytest

from drivers.device_text import MAX_CHARS, one_line


@pytest.mark.parametrize(
    ("sent", "shown"),
    [
        ("  V1.80.2  ", "V1.80.2"),
        ("Größe 1", "Größe 1"),
        ("LMS10x\nfront: a forged line", "LMS10x?front: a forged line"),
        ("\x1b[2J\rUTM-30LX\x9b1m", "?[2J?UTM-30LX?1m"),
        ("", ""),
        ("x" * 30_000, "x" * MAX_CHARS),
    ],
)
def test_a_text_of_a_device_is_one_plain_line(sent: str, shown: str):
    assert one_line(sent) == shown
