"""Two versions of a stored map beside each other, with a line that a slider moves."""

import pytest

from service.mapstore.files import save_map
from tests.browser.conftest import PHONE
from tests.browser.scene import Scene

EARLY, LATE = (-7.98, 7.97), (-6.98, 6.97)  # x of the walls left and right, m


@pytest.fixture
def versions(page, opened, tmp_path):
    for number, half_x_m in ((1, 8.0), (2, 7.0)):
        save_map(tmp_path, Scene(half_x_m=half_x_m).tiles(), number)
    opened(tmp_path, version=2)
    page.driver.find_element("xpath", "//button[text()='Compare']").click()
    page.wait_for("return corridor.view.other !== null")
    return page


def test_the_other_version_is_left_of_the_line_and_the_present_one_right_of_it(versions):
    def walls(percent=None):
        """Where there is one: early and late on the left, early and late on the right."""
        if percent is not None:
            versions.put("swipe-at", str(percent))
        versions.look_at(0.0, 0.0, 40.0)
        return [versions.pixel(x_m, 0.5) == [11, 18, 32] for x_m in (EARLY[0], LATE[0], EARLY[1], LATE[1])]

    assert walls(50) == [True, False, False, True]
    assert versions.text("swipe-words") == "Left: version 1. Right: 2, the present one."
    assert walls(0) == [False, True, False, True]
    assert walls(100) == [True, False, True, False]
    versions.element("swipe-end").click()
    assert walls() == [False, True, False, True]
    assert not versions.element("swipe").is_displayed()


def test_axe_finds_nothing_serious_on_a_phone(axe, versions):
    axe(versions, "map", sizes=[PHONE], schemes=[True])
