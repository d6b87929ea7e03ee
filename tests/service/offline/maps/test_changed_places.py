"""changes.json of a site: written, read, and refused where it is damaged."""

import json
from dataclasses import replace

import pytest

from service.errors import InputError
from service.offline.maps.changed_places import (
    CHANGED_PLACES_FILE,
    ChangedPlace,
    ChangedPlaces,
    read_changed_places,
    write_changed_places,
)

CRATE = ChangedPlace("new", 0.15, 0.18, 0.005, 1, 2, ["a", "b"], 3, "c", [[2, 3], [3, 3]])
SITE = ChangedPlaces(4, 0.05, [CRATE], {"a": {"places": 9, "gone": 0, "new": 1}})


def test_what_was_written_is_read_for_its_version_and_later_ones(tmp_path):
    assert read_changed_places(tmp_path, 4) is None
    write_changed_places(tmp_path, SITE)
    assert [read_changed_places(tmp_path, version) for version in (3, 4, 5)] == [None, SITE, SITE]


def test_the_newest_change_of_a_cell_is_shown():
    gone = replace(CRATE, change="gone", changed_ns=5, cells=[[3, 3], [4, 3]])
    shown = replace(SITE, places=[gone, CRATE]).as_map_changes()
    assert dict(zip(map(tuple, shown.xy_map.round(3).tolist()), shown.is_new.tolist(), strict=True)) == {
        (0.125, 0.175): True,
        (0.175, 0.175): False,
        (0.225, 0.175): False,
    }


@pytest.mark.parametrize("damage", [{"format": 2}, {"places": [{}]}, {"places": 3}, {"version": "4"}])
def test_a_damaged_file_is_named(tmp_path, damage):
    write_changed_places(tmp_path, SITE)
    path = tmp_path / CHANGED_PLACES_FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | damage))
    with pytest.raises(InputError, match="no list of changed places"):
        read_changed_places(tmp_path, 4)
