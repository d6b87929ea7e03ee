"""The page of corridor report, opened from a file."""

import numpy as np
import pytest

from service.mapstore.annotated import known_part
from service.offline.past.result import open_result
from service.offline.replay.replay import ReplayOptions, replay, write_replay
from service.offline.report import REPORT_FILE, write_report
from tests.browser.conftest import DESKTOP, PHONE
from tests.service.offline.recorded_drives import recorder_in


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """A result of 40 scans, six of them without a return, and its page."""
    recordings, folder = (tmp_path_factory.mktemp(name) for name in ("recordings", "out"))
    write_replay(replay([recorder_in(recordings)(covered=range(20, 26))], ReplayOptions()), folder)
    write_report(folder, folder / REPORT_FILE)
    return folder


@pytest.fixture
def report(page, out):
    page.driver.get((out / REPORT_FILE).as_uri())
    return page


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
@pytest.mark.parametrize("is_dark", [False, True])
def test_it_fits_every_screen_and_the_browser_complains_of_nothing(report, size, is_dark):
    report.resize(size, is_dark)
    assert report.run("return document.documentElement.scrollWidth <= innerWidth")
    assert report.faults() == []
    ground = report.run("return getComputedStyle(document.body).backgroundColor")
    levels = [int(level) for level in ground.removeprefix("rgb(").removesuffix(")").split(",")]
    assert np.mean(levels) < 64 if is_dark else np.mean(levels) > 192


def test_the_path_lies_where_the_map_has_it(report, out):
    """The vehicle drove 0.39 m along x, from the origin."""
    shown = known_part(open_result(out).picture)
    cells, begin, end = report.run(
        "return ['.cells', '.mark.begin', '.mark.end'].map(name => {"
        " const box = document.querySelector('.map ' + name).getBoundingClientRect();"
        " return [box.left, box.bottom, box.right, box.top]; })"
    )
    pixels_per_m = (cells[2] - cells[0]) / (shown.width * shown.cell_m)
    for mark, x_m in ((begin, 0.0), (end, 0.39)):
        middle_x, middle_y = (mark[0] + mark[2]) / 2, (mark[1] + mark[3]) / 2
        assert (middle_x - cells[0]) / pixels_per_m + shown.x_min_m == pytest.approx(x_m, abs=0.02)
        assert (cells[1] - middle_y) / pixels_per_m + shown.y_min_m == pytest.approx(0.0, abs=0.02)


def test_it_is_accessible(axe, report):
    report.run("document.querySelectorAll('details').forEach(details => { details.open = true; })")
    axe(report, sizes=[DESKTOP])
