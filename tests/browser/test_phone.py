"""The page on a phone: size of the map, and leaving every tool."""

import pytest
from selenium.webdriver.common.keys import Keys

from tests.browser.conftest import DESKTOP, PHONE, WIDE_CARDS

TOOLS = {  # by name: what puts it to work
    "measure": "document.getElementById('measure').click()",
    "pose": "const set = document.getElementById('do-set_pose'); set.disabled = false; set.click()",
    **{kind: f"document.getElementById('draw-{kind}').click()" for kind in ("rectangle", "area", "wall")},
}
LONG = "office is loaded, the map before is in /var/lib/corridor/maps/veh1_20260101T000000Z_0001. A copy?"
VERBS = ["save_map", "edit_map", "set_pose", "mark", "pause", "resume"]


@pytest.fixture
def phone(still):
    still.resize(PHONE)
    still.run(
        "corridor.connection.on.hello({run_id: '', vehicle: 'v', verbs: arguments[0], stores: true})", VERBS
    )
    still.choose("map")
    yield still
    still.resize(DESKTOP)
    still.choose("information")


def box(page, selector):
    """Left, top, right, bottom, pixels."""
    return page.run(
        "const {left, top, right, bottom} = document.querySelector(arguments[0]).getBoundingClientRect();"
        "return [left, top, right, bottom]",
        selector,
    )


@pytest.mark.parametrize("strip", ["replay", "past"])
def test_tools_and_strip_take_a_quarter_of_the_height_at_most(phone, strip):
    phone.run(
        "document.getElementById(arguments[0]).hidden = false;"
        "document.getElementById('past-time').textContent = '12:34 of 45:06 min';"
        "document.getElementById('past-note').textContent = 'the map as it was 10 s before';"
        "document.getElementById('replay-note').textContent = 'half of the recording is mapped'",
        strip,
    )
    heights = [bottom - top for _, top, _, bottom in (box(phone, f"#{strip}"), box(phone, ".tools"))]
    phone.run("document.getElementById(arguments[0]).hidden = true", strip)
    assert sum(heights) <= 0.25 * PHONE[1]


def test_names_of_areas_stand_apart_and_all_areas_fit_the_width(phone):
    gaps = phone.run(
        "const range = document.createRange(), boxes = [...document.querySelectorAll('.tabs button')]"
        ".filter((tab) => tab.offsetParent).map((tab) => {"
        " range.selectNodeContents(tab); return range.getBoundingClientRect(); });"
        "return boxes.slice(1).map((box, i) => box.left - boxes[i].right)"
    )
    assert len(gaps) == 5
    assert min(gaps) >= 10.0
    phone.run("document.getElementById('vehicle').textContent = 'veh1_20261122T171908Z_0001_of_the_drive'")
    for size in (DESKTOP, PHONE, (320, 640)):
        phone.resize(size)
        for area in ("information", "control", "edit", "history", "resources"):
            phone.choose(area)
            assert phone.run("return document.documentElement.scrollWidth") == size[0]
            assert size[0] < PHONE[0] or phone.run(f"return {WIDE_CARDS}.map((c) => c.innerText)") == []
            assert box(phone, "#tab-resources")[2] <= size[0]


@pytest.mark.parametrize("name", TOOLS)
def test_every_tool_is_ended_by_a_button(phone, name):
    phone.run(TOOLS[name])
    is_pointing = "return document.getElementById('map').classList.contains('pointing')"
    assert phone.run(is_pointing)
    left, _, right, bottom = box(phone, "#hint-bar")
    assert 0 <= left < right <= PHONE[0]
    assert bottom <= box(phone, ".tabs")[1]
    phone.element("cancel-tool").click()
    assert not phone.element("cancel-tool").is_displayed()
    assert not phone.run(is_pointing)


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_notices_cover_no_instruction_and_keep_their_buttons_whole(phone, size):
    phone.resize(size)
    phone.choose("edit")
    phone.run(TOOLS["area"])
    offer = "{text: 'Set its pose', act: () => {}}"
    phone.of_module("dom.js", f"[1, 2, 3].forEach((k) => m.notice(`${{k}}: ${{a[0]}}`, 'ok', {offer}))", LONG)
    left, top, right, bottom = box(phone, "#hint-bar")
    x0, y0, x1, y1 = box(phone, "#notices")
    assert x1 <= left or x0 >= right or y1 <= top or y0 >= bottom
    heights = phone.run("return [...document.querySelectorAll('.notice button')].map((b) => b.offsetHeight)")
    assert len(heights) == 6
    assert max(heights) <= 40
    phone.run("document.getElementById('notices').replaceChildren()")
    phone.element("map").send_keys(Keys.ESCAPE)


def test_a_tap_shows_why_a_control_is_disabled_and_what_a_column_is(phone):
    def notices_after(element, pointer):
        phone.run(
            "const {x, y, width, height} = arguments[0].getBoundingClientRect();"
            "const at = {clientX: x + width / 2, clientY: y + height / 2, pointerType: arguments[1]};"
            "document.getElementById('notices').replaceChildren();"
            "arguments[0].parentElement.dispatchEvent(new PointerEvent('pointerup', {...at, bubbles: true}))",
            element,
            pointer,
        )
        return phone.texts(".notice span")

    phone.choose("control")
    resume = phone.element("do-resume")
    assert not resume.is_enabled()
    assert notices_after(resume, "mouse") == []
    assert notices_after(resume, "touch") == ["Mapping is not paused."]
    phone.choose("information")
    head = phone.driver.find_element("xpath", "//th[text()='Delay ms']")
    assert notices_after(head, "touch") == ["from the measurement to its arrival."]
