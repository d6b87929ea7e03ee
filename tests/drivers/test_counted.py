import pytest

from drivers.counted import counted


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (counted(0, "scan"), "0 scans"),
        (counted(1, "scan"), "1 scan"),
        (counted(2, "key frame"), "2 key frames"),
        (counted(1, "fix", "fixes"), "1 fix"),
        (counted(3, "fix", "fixes"), "3 fixes"),
    ],
)
def test_a_noun_is_singular_for_one_alone(words: str, expected: str):
    assert words == expected
