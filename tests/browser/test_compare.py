"""Two versions of a stored map beside each other, with a line that a slider moves."""

import pytest

from service.mapstore.files import save_map
from tests.browser.conftest import PHONE
from tests.browser.scene import Scene

EARLY, LATE = Scene(), Scene(half_x_m=7.0)


@pytest.fixture
def versions(page, opened, tmp_path):
    save_map(tmp_path, EARLY.tiles(), 1)
    save_map(tmp_path, LATE.tiles(), 2)
    opened(tmp_path, version=2)
    page.run(
        "[...document.querySelectorAll('#edit button')].find((b) => b.textContent === 'Compare').click()"
    )
    page.wait_for("return corridor.view.other !== null")
    return page


def slide(page, percent):
    page.put("swipe-at", str(percent))
    page.look_at(0.0, 0.0, 40.0)


def test_the_other_version_is_left_of_the_line_and_the_present_one_right_of_it(versions):
    early, late = (-7.98, 0.5), (-6.98, 0.5)
    right = {"early": (7.97, 0.5), "late": (6.97, 0.5)}
    slide(versions, 50)
    wall = versions.pixel(*right["late"])
    assert versions.text("swipe-words") == "Left: version 1. Right: 2, the present one."
    assert versions.pixel(*early) == wall != versions.pixel(*late)
    assert versions.pixel(*right["early"]) != wall
    slide(versions, 0)
    assert versions.pixel(*late) == wall != versions.pixel(*early)
    slide(versions, 100)
    assert versions.pixel(*right["early"]) == wall != versions.pixel(*right["late"])
    versions.element("swipe-end").click()
    versions.look_at(0.0, 0.0, 40.0)
    assert versions.pixel(*late) == wall
    assert not versions.element("swipe").is_displayed()


def test_axe_finds_nothing_serious_on_a_phone(axe, versions):
    axe(versions, "map", sizes=[PHONE], schemes=[True])
