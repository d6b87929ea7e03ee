import numpy as np
import pytest

from service.errors import InputError
from service.mapper.map_changes import MapChanges
from service.offline.maps.change_file import read_changes, write_changes

CHANGES = MapChanges(
    0.1,
    np.array([[1.25, -0.35], [7.05, 2.15]]),
    np.array([True, False]),
    np.array([1_000, 2_000]),
    np.array([9_000, 8_000]),
    np.array([12, 7]),
)


def test_what_is_written_is_read_again(tmp_path):
    write_changes(tmp_path / "changes.csv", CHANGES)
    again = read_changes(tmp_path / "changes.csv", 0.05)
    assert again.has_same_cells(CHANGES)
    assert again.cell_m == CHANGES.cell_m
    assert [again.first_ns.tolist(), again.scans.tolist()] == [[1000, 2000], [12, 7]]
    assert read_changes(tmp_path / "none.csv", 0.05) is None


@pytest.mark.parametrize(
    "text", ["x_m,y_m\n1,2\n", "x_m,y_m,change,first_stamp_ns,last_stamp_ns,scans\na,b\n"]
)
def test_a_file_that_is_none_is_named(tmp_path, text):
    (tmp_path / "changes.csv").write_text(text)
    with pytest.raises(InputError, match=r"changes.csv: no changes.csv of a replay"):
        read_changes(tmp_path / "changes.csv", 0.05)
