import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.errors import InputError
from service.geometry.se2 import SE2
from service.offline.replay.states_file import COLUMNS, read_states, write_states
from service.outputs import NO_REASON, MapperOutput, Reason

T0_NS = 1_700_000_000_000_000_123
HEADS = ",".join(COLUMNS) + "\n"
# base axes: 3 cm ahead, 1 cm to the side, 2 deg; at a heading of 90 deg, which must not swap them
OUTPUT = MapperOutput(
    T0_NS,
    SE2(1.0, 2.0, math.pi / 2.0),
    SE2(),
    (0.5, 0.0, 0.0),
    np.diag([0.03**2, 0.01**2, math.radians(2.0) ** 2]),
    "ok",
    NO_REASON,
    0.875,
)
UNKNOWN = replace(
    OUTPUT,
    stamp_ns=T0_NS + 1,
    covariance=np.full((3, 3), math.nan),
    state="lost",
    reason=Reason("off_map", "3% of 541 returns lie on the map"),
    inlier_ratio=0.03,
)


def test_what_was_written_is_read_back(tmp_path: Path):
    write_states(tmp_path / "states.csv", [OUTPUT, UNKNOWN], ["front", "rear, low"])
    states = read_states(tmp_path / "states.csv")
    assert states.stamp_ns.tolist() == [T0_NS, T0_NS + 1]
    assert (states.state, states.reason_id) == (["ok", "lost"], ["", "off_map"])
    assert states.laser == ["front", "rear, low"]
    np.testing.assert_array_equal(states.sigma, [[0.03, 0.01, 2.0], [math.inf] * 3])
    np.testing.assert_array_equal(states.inlier_ratio, [0.875, 0.03])


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", r"states.csv:1: no column inlier_ratio, laser"),
        (HEADS + "1.5,ok\n", r"states.csv:2: fewer than 8 columns"),
        (HEADS + "now,ok,,0,0,0,1,front\n", r"states.csv:2: 'now' is no time"),
        (
            HEADS + "1.5,fine,,0,0,0,1,front\n",
            r"states.csv:2: the state 'fine' is none of ok, degraded, lost",
        ),
        (HEADS + "1.5,ok,,0,zero,0,1,front\n", r"states.csv:2: could not convert"),
        ("\udcff", "cannot be read as CSV"),
    ],
)
def test_a_damaged_file_is_bad_input_with_its_line(tmp_path: Path, text: str, fault: str):
    path = tmp_path / "states.csv"
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(InputError, match=fault):
        read_states(path)
