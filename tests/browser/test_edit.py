"""A stored map edited with the mouse, and with keys alone: from the click to the version on disk."""

import numpy as np
import pytest
from selenium.common.exceptions import TimeoutException
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

from service.geometry.se2 import SE2
from service.mapstore.files import load_map, save_map
from service.offline.maps import edit as map_edit
from service.offline.past.view import View
from service.offline.score.trajectory import write_tum
from tests.browser.conftest import open_view
from tests.service.mapstore.tile_makers import tile
from tests.service.offline.maps.bent_maps import ROUND, graph_in, save_bent
from tests.service.offline.maps.test_edit import cell

EDITED_WITHIN_S = 60.0  # a solution and a drawing on a machine that has more to do
PAIRED = (6, 22)  # key frames of the first round
CABINET = np.array([(9.9, 9.5), (11.6, 9.5), (11.6, 9.9), (9.9, 9.9)])  # around the front of one; seen once


@pytest.fixture
def view(opened, folder):
    return opened(folder)


@pytest.fixture(scope="module")
def unchanged_view(tmp_path_factory, bent):
    view = View(save_bent(tmp_path_factory.mktemp("unchanged") / "ring", bent), "127.0.0.1:0")
    yield view
    view.close()


@pytest.fixture
def unchanged(share, unchanged_view):
    """A page as `view` has it, shared by those who change nothing of the map; no place is chosen."""
    page = share(unchanged_view.address, lambda page: open_view(page, unchanged_view))
    page.choose("edit")
    page.run("document.getElementById('forget-places').click()")
    return page


def offset_of(page, x_m, y_m):
    """Of a point of the map from the middle of the canvas, pixels."""
    return page.run(
        "const c = corridor.view.camera, [x, y] = c.toScreen(arguments[0], arguments[1]);"
        "return [Math.round(x - c.width / 2), Math.round(y - c.height / 2)]",
        float(x_m),
        float(y_m),
    )


def click_map(page, x_m, y_m):
    dx, dy = offset_of(page, x_m, y_m)
    page.pointer().move_to_element_with_offset(page.element("map"), dx, dy).click().perform()


def drag_map(page, from_m, to_m):
    canvas = page.element("map")
    actions = page.pointer().move_to_element_with_offset(canvas, *offset_of(page, *from_m))
    actions.click_and_hold().move_to_element_with_offset(canvas, *offset_of(page, *to_m)).release().perform()


def choose_places(page, k):
    """Key frame k as place A, that of a round later as B."""
    page.run(
        "const {a, b} = corridor.edit.pairs.places; a.choose(arguments[0]); b.choose(arguments[1])",
        k,
        k + ROUND,
    )
    page.wait_for(
        "const {a, b} = corridor.edit.pairs.places;"
        "return a.points.length && b.points.length && !a.loading && !b.loading"
    )


def pick_at(page, bent, k):
    """Points of both places are then picked; the middle of the map is between them."""
    choose_places(page, k)
    page.look_at(*(bent.graph.map[k, :2] + bent.graph.map[k + ROUND, :2]) / 2, 100.0)
    page.element("pick-pairs").click()


def pick_pairs(page, bent, k):
    """All points that both places have in common, with the mouse; the places, too."""
    here, there = bent.graph.map[k, :2], bent.graph.map[k + ROUND, :2]
    page.look_at(*(here + there) / 2, 100.0)
    for side, place in (("a", here), ("b", there)):
        page.element(f"place-{side}-pick").click()
        click_map(page, *place)
        page.wait_for("return corridor.edit.pairs.places[arguments[0]].points.length > 0", side)
    chosen = page.run("const {a, b} = corridor.edit.pairs.places; return [a.keyframe, b.keyframe]")
    assert chosen == [k, k + ROUND]
    page.element("pick-pairs").click()
    for first, second in bent.common_points(k):
        page.look_at(*(first + second) / 2, 150.0)
        click_map(page, *first)
        page.wait_for_text("hint", "Now the same point")
        click_map(page, *second)
    page.element("map").send_keys(Keys.ESCAPE)


def optimise(page):
    """With pairs that are more than 0.5 m apart, which is asked about."""
    page.element("optimise").click()
    page.answer()


def wait_for_version(page, number):
    """Until the change is made. A refusal that is shown may still be that of the change before."""
    is_made = "return corridor.edit.version === arguments[0] && !corridor.edit.isBusy"
    try:
        WebDriverWait(page.driver, EDITED_WITHIN_S).until(lambda d: d.execute_script(is_made, number))
    except TimeoutException:
        raise AssertionError(f"no version {number}: {page.text('edit-note')}") from None
    assert page.element("edit-note").get_attribute("data-level") == "ok", page.text("edit-note")


def residuals_m(page):
    return page.run(
        "return [...document.querySelectorAll('#pairs .note')].map((e) => parseFloat(e.textContent))"
    )


def canvas_of(page):
    """As text."""
    page.redraw()
    return page.run("return document.getElementById('map').toDataURL()")


def test_a_bent_map_is_straightened_by_clicks_compared_and_taken_back(page, view, folder, bent):
    assert bent.error_m(graph_in(folder)) > 0.5
    for k in PAIRED:
        pick_pairs(page, bent, k)
    rows = residuals_m(page)
    apart_m = [float(np.hypot(*(a - b))) for k in PAIRED for a, b in bent.common_points(k)]
    np.testing.assert_allclose(rows, apart_m, atol=0.03)  # a pixel or two
    optimise(page)
    wait_for_version(page, 2)
    assert bent.error_m(graph_in(folder)) < 0.10
    assert "moved by up to" in page.text("edit-note")
    assert len(residuals_m(page)) == 6
    assert max(residuals_m(page)) < 0.05
    page.wait_for("return corridor.view.tiles.tiles.size > 0 && corridor.view.before !== null")
    page.element("fit").click()
    page.element("forget-places").click()  # their points lie on the present map only
    after = canvas_of(page)
    page.element("show-before").click()
    assert canvas_of(page) != after
    page.element("show-before").click()
    assert canvas_of(page) == after
    page.wait_for("return !corridor.view.showsBefore")
    page.element("edit-undo").click()
    wait_for_version(page, 3)
    np.testing.assert_array_equal(graph_in(folder).map, bent.graph.map)
    assert page.faults() == []


def test_a_new_pair_and_one_of_the_map_are_removed(page, view, folder, bent):
    k = PAIRED[0]
    first, second = bent.common_points(k)[0]
    pick_at(page, bent, k)
    page.look_at(*(first + second) / 2, 150.0)
    for points in 3 * (first, second):
        click_map(page, *points)
    assert page.text("optimise") == "Optimise with 3 new"
    page.press("Remove New 1")
    page.element("optimise").click()  # 0.5 m apart at most: nothing is asked
    wait_for_version(page, 2)
    assert len(graph_in(folder).by_hand.pair_ends) == 2
    page.press("Remove Pair 0")
    wait_for_version(page, 3)
    assert len(graph_in(folder).by_hand.pair_ends) == 1
    page.press("Remove Pair 0")
    page.wait_for_text("edit-note", "2 parts of the map would be disconnected")
    assert load_map(folder).number == 3


def test_pairs_are_picked_with_keys_alone(page, view, folder, bent):
    k = PAIRED[0]

    def wait_for_place(side, least, most):
        page.wait_for(
            "const p = corridor.edit.pairs.places[arguments[0]];"
            "return !p.loading && arguments[1] <= p.keyframe && p.keyframe <= arguments[2]",
            side, least, most,
        )  # fmt: skip

    page.element("place-a").send_keys(Keys.HOME, *(k * [Keys.ARROW_RIGHT]))
    wait_for_place("a", k, k)
    page.element("other-pass").send_keys(Keys.ENTER)
    wait_for_place("b", k + ROUND - 3, k + ROUND + 3)
    off = page.run("return corridor.edit.pairs.places.b.keyframe") - k - ROUND
    page.element("place-b").send_keys(*(abs(off) * [Keys.ARROW_RIGHT if off < 0 else Keys.ARROW_LEFT]))
    wait_for_place("b", k + ROUND, k + ROUND)
    page.element("pick-pairs").send_keys(Keys.ENTER)
    for points in bent.common_points(k):
        for point in points:
            page.look_at(*point, 400.0)
            page.driver.switch_to.active_element.send_keys(Keys.ENTER)
    page.element("optimise").send_keys(Keys.ENTER)
    page.wait_for("return document.getElementById('confirm').open")
    page.element("confirm-yes").send_keys(Keys.ENTER)
    wait_for_version(page, 2)
    assert bent.error_m(graph_in(folder)) < 0.10


def test_a_click_beside_all_points_picks_none(unchanged, bent):
    pick_at(unchanged, bent, PAIRED[0])
    click_map(unchanged, *bent.graph.map[PAIRED[0], :2])
    unchanged.wait_for_text("hint", "No point of place A is near there")
    assert unchanged.run("return corridor.edit.pairs.pairs.length") == 0


def front_of_cabinet(folder):
    """A point of the map where it stands."""
    ys_m = np.arange(9.525, 9.9, 0.05).tolist()
    return next((10.775, y_m) for y_m in ys_m if cell(load_map(folder).tiles, 10.775, y_m) > 65)


def test_an_area_is_erased_by_dragging_and_brought_back(page, view, folder):
    spot = front_of_cabinet(folder)
    page.look_at(*CABINET.mean(axis=0), 150.0)
    page.element("draw-rectangle").click()
    drag_map(page, CABINET.min(axis=0), CABINET.max(axis=0))
    wait_for_version(page, 2)
    assert page.text("edit-note").startswith("Erase: erased 0.68 m")
    assert cell(load_map(folder).tiles, *spot) == -1
    page.wait_for("return corridor.view.tiles.valueAt(...arguments) === -1", *spot)
    assert load_map(folder).edit.who == map_edit.user_name()
    page.element("edit-undo").click()
    wait_for_version(page, 3)
    assert cell(load_map(folder).tiles, *spot) > 65
    page.wait_for("return corridor.view.tiles.valueAt(...arguments) > 65", *spot)


def test_an_area_by_corners_is_whole_at_its_first_corner_and_a_no_changes_nothing(page, view, folder):
    spot = front_of_cabinet(folder)
    page.look_at(*CABINET.mean(axis=0), 150.0)
    page.element("edit-who").clear()
    page.element("edit-who").send_keys("ada")
    page.put("erase-becomes", "free")
    page.element("draw-area").click()
    for corner in (*CABINET, CABINET[0]):
        click_map(page, *corner)
    page.answer("no")
    assert load_map(folder).number == 1
    assert page.text("draw-words") == "4 corners, 0.68 m\u00b2"
    page.element("erase").click()
    page.answer()
    wait_for_version(page, 2)
    stored = load_map(folder)
    assert (stored.edit.who, stored.edit.what) == ("ada", "erase")
    assert 0 <= cell(stored.tiles, *spot) < 10


def test_a_wall_is_drawn_with_keys_alone(page, view, folder):
    page.look_at(6.0, 0.0, 60.0)
    page.element("draw-wall").send_keys(Keys.ENTER)
    to_and_fro = (Keys.ARROW_RIGHT, Keys.ENTER, Keys.ARROW_UP, Keys.ENTER, Keys.BACKSPACE, Keys.ARROW_DOWN)
    for key in (Keys.ENTER, *to_and_fro):
        page.driver.switch_to.active_element.send_keys(key)
    assert page.text("draw-words") == "2 points, 1.00 m"
    page.driver.switch_to.active_element.send_keys(Keys.ENTER)  # the last point again
    page.wait_for("return document.getElementById('confirm').open")
    page.element("confirm-yes").send_keys(Keys.ENTER)
    wait_for_version(page, 2)
    assert cell(load_map(folder).tiles, 6.5, 0.0) == 97
    page.wait_for("return corridor.view.tiles.valueAt(6.5, 0.0) === 97")


def test_a_time_span_is_cut_out_by_clicking_the_path(page, view, folder, bent):
    first, last = 30, 40
    page.look_at(*bent.graph.map[35, :2], 60.0)
    for end, k in (("from", first), ("to", last)):
        page.element(f"cut-{end}-pick").click()
        click_map(page, *bent.graph.map[k, :2])
    assert page.element("cut-from").get_attribute("value") == "3.00"
    assert page.text("cut-words") == "In it: 11 key frames."
    page.element("cut").click()
    page.answer()
    page.wait_for_text("edit-note", "would be disconnected")
    assert load_map(folder).number == 1
    page.element("cut-bridge").click()
    page.element("cut").click()
    page.answer()
    wait_for_version(page, 2)
    assert len(graph_in(folder)) == len(bent.graph) - 11


def test_the_result_of_a_change_is_shown_once_the_next_one_can_be_made(page, view):
    """The operator may click at once; a click on what is still disabled would be lost."""
    page.run(
        "const ask = corridor.connection.command.bind(corridor.connection);"
        "const delayed = new Promise((settle) => { window.letLook = settle; });"
        "corridor.connection.command = async (verb, request) => {"
        "  if (verb === 'map_look') { window.looks = true; await delayed; }"
        "  return ask(verb, request); };"
        "corridor.edit.change({what: 'wall', corners: [[6, 0], [7, 0]]}, 'Wall')"
    )
    page.wait_for("return window.looks")
    assert page.text("edit-note") == "Wall: the map is being changed \u2026"
    page.run("window.letLook()")
    page.wait_for_text("edit-note", "drew a wall")
    assert page.element("draw-rectangle").is_enabled()


def test_without_a_connection_nothing_can_be_changed(page, view):
    assert page.element("draw-rectangle").is_enabled()
    view.close()
    page.wait_for_text("state", "no connection")
    assert not page.element("draw-rectangle").is_enabled()


def test_more_points_than_a_change_may_have_are_not_taken(unchanged):
    unchanged.element("draw-wall").click()
    unchanged.run("for (let i = 0; i < 501; i += 1) corridor.edit.tool.click([20 * (i % 40), 15 * (i % 37)])")
    unchanged.wait_for_text("hint", "500 points at most")
    assert unchanged.run("return corridor.edit.tool.corners.length") == 500


def test_what_another_client_changed_is_seen_and_not_written_over(page, view, folder):
    map_edit.edit_map(folder, "wall", map_edit.wall([0, 0, 1, 0]), "bob", 5)
    page.run("corridor.edit.change({what: 'wall', corners: [[6, 0], [7, 0]]}, 'Wall')")
    page.wait_for_text("edit-note", "the map is at version 2")
    page.wait_for("return corridor.edit.version === 2")
    assert "bob" in page.text("versions")
    page.driver.find_element("xpath", "//button[text()='Go back to version 1\u2026']").click()
    page.answer()
    wait_for_version(page, 3)
    assert load_map(folder).edit.restores == 1


def test_a_map_without_a_graph_is_drawn_in(page, opened, tmp_path):
    save_map(tmp_path / "picture", [tile(0, 0, 1, value=97), tile(1, 0, 2, value=97)], 1)
    opened(tmp_path / "picture")
    assert page.element("draw-rectangle").is_enabled()
    assert not page.element("optimise").is_displayed()
    assert not page.element("cut").is_displayed()


def test_the_path_goes_with_the_map_that_is_bent(page, opened, tmp_path, bent):
    def end_of(points):
        """Until the path, or the pose, ends where the map has it now."""
        page.wait_for(
            f"const [x, y] = {points}; return Math.hypot(x - arguments[0], y - arguments[1]) < 1e-3",
            *graph_in(folder).map[-1, :2].tolist(),
        )

    rows = zip(bent.graph.stamp_ns.tolist(), bent.graph.map.tolist(), strict=True)
    write_tum(tmp_path / "trajectory.tum", [(stamp_ns, SE2(*pose)) for stamp_ns, pose in rows])
    folder = save_bent(tmp_path / "map", bent)
    opened(tmp_path)
    page.element("past-position").send_keys(Keys.END)
    page.wait_for("const m = corridor.report().moment; return m.position_s === m.duration_s")
    assert "\u00b1 \u2013" in page.text("information")  # a trajectory has no covariance
    pairs = [(points.ravel().tolist(), (k, k + ROUND)) for k in PAIRED for points in bent.common_points(k)]
    map_edit.edit_map(folder, "add-pair", map_edit.add_pairs(pairs), "bob", 5)
    page.run("corridor.edit.change({what: 'optimize'}, 'Optimise')")  # is refused, and the newer map shown
    page.wait_for("return corridor.edit.version === 2")
    end_of("corridor.view.path.slice(-2)")
    end_of("[corridor.report().pose.x_m, corridor.report().pose.y_m]")
    shown = np.reshape(page.run("return [...corridor.view.path]"), (-1, 2))
    np.testing.assert_allclose(shown, graph_in(folder).map[:, :2], atol=1e-3)


def test_every_control_can_be_reached_with_the_keyboard(page, view):
    page.run("document.getElementById('tab-edit').focus()")
    reached = []
    for _ in range(24):
        page.pointer().send_keys(Keys.TAB).perform()
        reached.append(page.driver.switch_to.active_element.get_attribute("id"))
    places = {"place-a", "place-a-pick", "optimise"}
    drawing = {"draw-rectangle", "draw-area", "draw-wall", "erase-becomes"}
    cut = {"cut-from", "cut-from-pick", "cut-to", "cut-bridge"}
    assert places | drawing | cut | {"edit-who"} <= set(reached)


def test_axe_finds_nothing_serious_in_the_area_edit(axe, page, view):
    page.run("corridor.edit.change({what: 'wall', corners: [[6, 0], [7, 0]]}, 'Wall')")
    wait_for_version(page, 2)
    choose_places(page, PAIRED[0])
    axe(page, "edit")
