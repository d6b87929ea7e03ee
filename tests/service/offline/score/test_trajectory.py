import math

import numpy as np
import pytest

from service.errors import InputError
from service.geometry.se2 import SE2
from service.offline.score.trajectory import parse_stamp, read_tum, write_tum


def test_a_trajectory_comes_back_with_its_stamps_to_the_nanosecond(tmp_path):
    random = np.random.default_rng(1)
    stamps = 1_211_667_623_001_236_001 + np.cumsum(random.integers(1, 10**9, 200))
    poses = [SE2(*random.uniform(-1000, 1000, 2), random.uniform(-math.pi, math.pi)) for _ in stamps]
    path = tmp_path / "a.tum"
    write_tum(path, zip(stamps.tolist(), poses, strict=True))
    back = read_tum(path)
    assert back.stamp_ns.tolist() == stamps.tolist()
    np.testing.assert_allclose(back.pose, [[p.x_m, p.y_m, p.theta_rad] for p in poses], atol=1e-9)


STAMPS = {
    "1216.630413": 1_216_630_413_000,
    "1.305031102175300000e+09": 1_305_031_102_175_300_000,
    "1211667623.123456789": 1_211_667_623_123_456_789,
    "7": 7_000_000_000,
    "-0.5": -500_000_000,
    "0.0000000016": 2,
}


def test_stamps_are_read_exactly():
    assert {text: parse_stamp(text, "here") for text in STAMPS} == STAMPS


@pytest.mark.parametrize("text", ["", "abc", "nan", "inf", "1e30", "1e999999999", "1,5"])
def test_what_is_no_stamp_is_refused(text):
    with pytest.raises(InputError, match=r"f:3: .* is no time in seconds"):
        parse_stamp(text, "f:3")


GOOD = "1.0 0 0 0 0 0 0 1\n# comment\n\n2.0 1 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("line", "diagnostic"),
    [
        ("3.0 1 2 3", r"a\.tum:5: 4 columns; expected 8: stamp tx ty"),
        ("3.0 1 2 x 0 0 0 1", r"a\.tum:5: could not convert string to float: 'x'"),
        ("3.0 1 nan 0 0 0 0 1", r"a\.tum:5: .*expected finite numbers"),
        ("3.0 1 2 0 0 0 0 0", r"a\.tum:5: the quaternion's length is 0.0000, expected 1"),
        ("2.0 1 2 0 0 0 0 1", r"a\.tum:5: the stamp 2.0 does not rise"),
        ("t 1 2 0 0 0 0 1", r"a\.tum:5: 't' is no time"),
    ],
)
def test_a_bad_line_is_named(tmp_path, line, diagnostic):
    path = tmp_path / "a.tum"
    path.write_text(GOOD + line + "\n")
    with pytest.raises(InputError, match=diagnostic):
        read_tum(path)


def test_a_file_that_is_none_is_refused(tmp_path):
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "one").write_text("1.0 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="No such file"):
        read_tum(tmp_path / "nowhere")
    with pytest.raises(InputError, match="not a text file"):
        read_tum(tmp_path / "binary")
    with pytest.raises(InputError, match="1 pose; a trajectory has at least 2"):
        read_tum(tmp_path / "one")
