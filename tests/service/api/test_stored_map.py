from dataclasses import replace

import numpy as np
import pytest

import corridor
from tests.service.api.rooms import MOUNTINGS, driven


def test_a_scan_is_found_in_the_map_and_the_map_stays_as_it_is(stored):
    loaded = corridor.Map.load(stored)
    assert (loaded.version, loaded.about["profile"], loaded.geo) == (1, "corridor", None)
    assert loaded.grid.cells.max() > 65
    before = sorted(stored.rglob("*"))
    scans = [frame for frame in driven().frames if isinstance(frame, corridor.LaserScan)]
    for scan in (scans[-1], replace(scans[0], scan_period_ns=0)):  # each call searches again
        pose = loaded.localize(scan, mountings=MOUNTINGS)
        true = driven().truth[scan.stamp_ns]
        assert np.hypot(pose.x_m - true.x_m, pose.y_m - true.y_m) < 0.02
        assert pose.stamp_ns == scan.stamp_ns
        assert pose.state == "degraded"  # from one viewpoint
    assert sorted(stored.rglob("*")) == before


def test_a_scan_that_fits_nowhere_has_no_pose(stored):
    angle = np.linspace(-2.0, 2.0, 400)
    elsewhere = corridor.scan(1.0 + 0.3 * np.sin(5.0 * angle), -2.0, 0.01, 10**9)
    assert corridor.Map.load(stored).localize(elsewhere) is None


def test_a_folder_without_a_map_is_refused(tmp_path, stored):
    with pytest.raises(corridor.InputError, match="no stored map"):
        corridor.Map.load(tmp_path)
    with pytest.raises(corridor.InputError, match="no version 7"):
        corridor.Map.load(str(stored), 7)
