import math
from itertools import product

import numpy as np
import pytest
from selenium.webdriver.common.keys import Keys

from service.encoding import decode_pose, encode_graph, encode_grid, encode_pose
from service.outputs import NO_GRAPH, OCCUPIED, GraphPicture, Grid, TileUpdate
from tests.browser.conftest import DESKTOP
from tests.browser.scene import CELL_M, EDGE, MOUNTINGS, Scene, stamp

WALL, FREE, GROUND = [11, 18, 32], [255, 255, 255], [228, 232, 238]  # of the light theme
APPEARED, GONE = [190, 24, 93], [3, 105, 161]
BLUE = [29, 78, 216]  # of key frames, and of what stands for long
CAMERA = "const c = corridor.view.camera; return [c.x_m, c.y_m, c.scale, c.rotation_rad]"


def only_the_map(page, layer=""):
    """And one more layer."""
    page.run("Object.assign(corridor.view.layers, {path: 0, scans: 0, vehicle: 0, grid: 0})")
    if layer:
        page.run("document.getElementById(arguments[0]).click()", f"layer-{layer}")


def pixels(page, x_m, y_m, pixels_per_m, *points):
    """At points of the map, around a place that is looked at."""
    page.look_at(x_m, y_m, pixels_per_m)
    return [page.pixel(*point) for point in points or [(x_m, y_m)]]


def points_of(page, name):
    return np.reshape(page.run("return [...corridor.view.scans.get(arguments[0]).points]", name), (-1, 2))


def off_walls_m(scene, points):
    return np.abs(np.abs(points) - (scene.half_x_m, scene.half_y_m)).min(axis=1).max()


def test_the_map_appears_and_grows(page, scene, live):
    assert page.report()["tiles"] == len(scene.tiles())
    assert page.report()["follows"]
    only_the_map(page)
    wall_m = (scene.half_x_m - CELL_M / 2, 1.0)
    around = [(wall_m[0] + k * CELL_M, 1.0) for k in (-1, 0, 1)]
    assert pixels(page, *wall_m, 400.0, *around) == [FREE, WALL, GROUND]
    cells = np.random.default_rng(7).integers(-1, 101, (EDGE, EDGE), dtype=np.int8)
    scene.store.update([TileUpdate(0, 20, -1, scene.store.version + 1, CELL_M, cells)])
    page.wait_for("return corridor.report().tiles === arguments[0]", len(scene.tiles()) + 1)
    points = [
        [64.0 + (c + 0.5) * CELL_M, -3.2 + (r + 0.5) * CELL_M] for r in range(EDGE) for c in range(EDGE)
    ]
    shown = page.run("return arguments[0].map(([x, y]) => corridor.view.tiles.valueAt(x, y))", points)
    assert shown == cells.ravel().tolist()
    scene.store.start_over()
    page.wait_for("const r = corridor.report(); return r.tiles === 0 && r.pathPoints === 0")
    page.wait_for("return !document.getElementById('empty').hidden")
    assert page.faults() == []


def test_a_wall_is_seen_at_every_zoom_and_turn(page, scene, live):
    only_the_map(page)
    wall_x_m, y_m = scene.half_x_m - CELL_M / 2, 0.5 * CELL_M
    darkest = {}
    for turn_rad, per_m in product((0.0, 0.7), (4000.0, 100.0, 12.0, 1.5)):
        page.run("corridor.view.camera.rotation_rad = arguments[0]", turn_rad)
        around = pixels(page, wall_x_m, y_m, per_m, *[(wall_x_m + dx / per_m, y_m) for dx in (-1, 0, 1)])
        darkest[turn_rad, per_m] = min(map(sum, around))
    assert {case: shade for case, shade in darkest.items() if shade >= sum(WALL) + 20} == {}


def test_pose_and_its_words_agree_with_the_message_and_the_vehicle_is_followed(page, scene, live):
    for tenth in range(11, 31):
        message = encode_pose(scene.output(tenth / 10), stamp(tenth / 10))
        live.put(message)
        page.wait_for("return corridor.report().pose.stamp_ns === arguments[0]", str(stamp(tenth / 10)))
    expected, report = decode_pose(message.payload), page.report()
    pose, shown = expected.pose, report["pose"]
    assert [shown[name] for name in ("x_m", "y_m", "theta_rad")] == [pose.x_m, pose.y_m, pose.theta_rad]
    np.testing.assert_allclose(shown["covariance"], expected.covariance.ravel(), atol=1e-15)
    c, s = math.cos(pose.theta_rad), math.sin(pose.theta_rad)
    in_map = np.array([[c, -s], [s, c]]) @ expected.covariance[:2, :2] @ np.array([[c, s], [-s, c]])
    x_std_cm, heading_deg = 100 * math.sqrt(in_map[0, 0]), math.degrees(pose.theta_rad)
    page.wait_for_text("information", f"{pose.x_m:.3f} m \u00b1 {x_std_cm:.1f} cm")
    assert f"{heading_deg:.1f}" in page.text("information")
    assert report["follows"]
    assert report["pathPoints"] > 15
    assert page.run(CAMERA)[:2] == [pose.x_m, pose.y_m]
    page.wait_for("return !corridor.view.isLive")  # no pose for 1.5 s


def test_a_scan_is_shown_at_its_pose_once_that_has_come(page, scene, live):
    """Poses come late where the service is overloaded, and not at all where mapping is paused."""
    page.wait_for("const s = corridor.report().scanPoints; return s.front > 0 && s.rear > 0")
    for name in MOUNTINGS:
        assert len(points_of(page, name)) == scene.scan(name, 1.0).range_m.size
        assert off_walls_m(scene, points_of(page, name)) < 0.01
    assert len({page.run("return corridor.view.colourOf(arguments[0])", name) for name in MOUNTINGS}) == 2
    shown_s = "Math.round(corridor.view.scans.get('front').scan.stamp_s - arguments[0])"
    first_s = page.run("const v = corridor.view; v.isHeld = true; return v.track.last.stamp_s")
    for later_s in (1, 2):
        for message in scene.messages(1.0 + later_s)[2:]:
            live.put(message)
        page.wait_for("return corridor.view.coming.get('front').length === arguments[0]", later_s)
        page.look_at(0.0, 0.0, 40.0)
        assert page.run(f"return {shown_s}", first_s) == 0
    live.put(scene.messages(2.0)[1])
    page.wait_for(f"return {shown_s} === 1", first_s)
    page.look_at(0.0, 0.0, 40.0)
    assert off_walls_m(scene, points_of(page, "front")) < 0.01


def test_a_scan_of_a_moving_vehicle_is_laid_out_beam_by_beam(page, live):
    """1 m/s forward: the last of 361 beams, each 1 ms after the other, is 0.36 m further on.

    Of a laser that the drive has not: a scan of the drive that waits for its pose would replace it.
    """
    page.run(
        "const v = corridor.view, stamp_s = v.track.last.stamp_s, ranges = new Uint16Array(361).fill(200);"
        "const beams = {first_angle_rad: 0, angle_step_rad: 0, beam_interval_s: 1e-3};"
        "v.track.last.twist = [1, 0, 0]; v.mountings.third = [0, 0, 0];"
        "v.scans.set('third', {scan: {sensor: 'third', stamp_s, ...beams, ranges}}); v.invalidate();"
    )
    page.wait_for("return corridor.view.scans.get('third').points")
    points = points_of(page, "third")
    assert np.hypot(*(points[-1] - points[0])) == pytest.approx(0.36, abs=1e-6)


def test_no_line_is_shown_across_a_jump_of_the_pose(page, live):
    page.run("Object.assign(corridor.view.layers, {scans: 0, vehicle: 0, grid: 0})")
    before = page.run("return corridor.view.path.length")
    page.run(
        "const v = corridor.view, last = v.track.last;"
        "for (const [x_m, later_s] of [[-4, 0.1], [-3.5, 0.2], [3, 0.3], [3.5, 0.4]])"
        " v.putPose({...last, x_m, y_m: 3, stamp_s: last.stamp_s + later_s})"
    )
    points = page.run("return corridor.view.path.slice(arguments[0])", before)
    assert points == [None, None, -4, 3, -3.5, 3, None, None, 3, 3, 3.5, 3]
    driven, leapt, also_driven = pixels(page, 0.0, 3.0, 60.0, (-3.75, 3.0), (0.0, 3.0), (3.25, 3.0))
    assert also_driven == driven != leapt


def test_a_map_that_is_still_coming_is_all_in_view_until_somebody_moves_it(page, serve, store):
    first, *others = Scene(half_x_m=30.0, store=store).tiles()

    def is_all_seen():
        seen, bounds = page.run("return [corridor.view.camera.seen, corridor.view.tiles.bounds]")
        return all(
            seen[f"{axis}_min_m"] <= bounds[f"{axis}_min_m"]
            and seen[f"{axis}_max_m"] >= bounds[f"{axis}_max_m"]
            for axis in "xy"
        )

    store.update([first])
    page.open(serve().address)
    page.wait_for("return corridor.report().tiles === 1")
    store.update(others[:-1])
    page.wait_for("return corridor.report().tiles === arguments[0]", len(others))
    assert is_all_seen()
    page.look_at(1.0, 2.0, 50.0)
    store.update(others[-1:])
    page.wait_for("return corridor.report().tiles === arguments[0]", 1 + len(others))
    assert page.run(CAMERA)[:3] == [1, 2, 50]
    page.element("fit").click()
    assert is_all_seen()


def test_the_graph_is_a_layer_with_its_parts_explained(page, live):
    line = np.array([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]], np.float32)
    accepted = np.array([[[-2.0, 1.0], [2.0, 1.0]]], np.float32)
    refused = np.array([[[-2.0, 2.0], [2.0, 2.0]], [[-2.0, 3.0], [2.0, 3.0]]], np.float32)
    border = np.array([[-3.0, -3.0], [3.0, -3.0], [3.0, 3.5], [-3.0, 3.5]], np.float32)
    live.put(encode_graph(GraphPicture(stamp(1.0), [line], accepted, refused, [border]), stamp(1.0)))
    page.wait_for("return corridor.report().graph.keyFrames === 3")
    assert page.report()["graph"] == {"keyFrames": 3, "accepted": 1, "refused": 2, "borders": 1}
    words = page.texts(".graph-part")
    assert words == ["Key frames: 3", "Loops that hold: 1", "Loops not accepted: 2", "Sub-maps: 1"]
    only_the_map(page)
    assert pixels(page, 0.0, 1.0, 400.0) == [FREE]  # it is off at first
    only_the_map(page, "graph")
    assert pixels(page, 0.0, 1.0, 400.0) == [[21, 128, 61]]
    assert pixels(page, 0.0, 0.0, 400.0) == [BLUE]
    page.look_at(3.0, -1.0, 400.0)
    ink = page.run(
        "const v = corridor.view, [x] = v.camera.toScreen(3, -1), h = v.canvas.height;"
        "const d = v.context.getImageData(Math.floor(x * v.dpr), 0, 1, h).data;"
        "return [...Array(h).keys()].filter((i) => d[4 * i] < 200).length / h"
    )
    assert 0.4 < ink < 0.9  # dashes
    live.put(encode_graph(NO_GRAPH, stamp(2.0)))
    page.wait_for("return corridor.report().graph.keyFrames === 0")


def test_the_static_score_is_a_layer_from_just_come_to_stands_for_long(page, scene, live):
    only_the_map(page, "standing")
    assert "Not known now" in page.text("parts-standing")
    cells = np.full((20, 30), -1, np.int8)
    cells[10, 10], cells[10, 20] = 0, 100
    live.put(encode_grid(Grid(0, 0.1, -1.0, 1.0, cells), stamp(1.0), stamp(1.0), "standing"))
    page.wait_for("return corridor.view.standing.isKnown")
    fresh, full, between = (0.05, 2.05), (1.05, 2.05), (0.55, 2.05)
    points = [fresh, full, (0.05, 2.15), (-1.05, 2.0), (5.0, 2.0)]
    values = page.run("return arguments[0].map((xy) => corridor.view.standing.valueAt(...xy))", points)
    assert values == [0, 100, -1, -1, -1]
    words = page.texts(".standing-part")
    assert words == ["Just come: counts little", "Stands for long: counts in full"]
    assert pixels(page, 0.5, 2.0, 200.0, fresh, full, between) == [[220, 38, 38], BLUE, FREE]
    page.run(
        "const [x, y] = corridor.view.camera.toScreen(1.05, 2.05), map = document.getElementById('map'),"
        " box = map.getBoundingClientRect();"
        "map.dispatchEvent(new PointerEvent('pointermove', {clientX: box.left + x, clientY: box.top + y}))"
    )
    assert page.text("cursor").endswith("static score 100 %")
    page.resize(DESKTOP, is_dark=True)
    try:
        assert pixels(page, 0.5, 2.0, 200.0, full) == [[110, 168, 255]]
    finally:
        page.resize(DESKTOP)
    scene.store.start_over()
    page.wait_for("return !corridor.view.standing.isKnown")


def test_what_is_not_as_the_stored_map_says_is_a_layer(page, scene, live):
    only_the_map(page)
    assert page.run(
        "return document.getElementById('layer-stored').parentElement.hidden"
    )  # no client watches
    cells = np.full((3, 12), -1, np.int8)
    cells[1, 1], cells[2, 11] = 100, 0
    live.put(encode_grid(Grid(0, 0.1, -1.0, 1.0, cells), stamp(1.0), stamp(1.0), "map/changes"))
    page.wait_for("const c = corridor.report().stored; return c.appeared === 1 && c.gone === 1")
    assert page.texts(".stored-part") == ["Stands there now: 1 cell", "Is gone: 1 cell"]
    assert page.element("layer-stored").is_selected()
    shown = pixels(page, -0.4, 1.2, 200.0, (-0.85, 1.15), (0.15, 1.25), (-0.45, 1.15))
    assert shown == [APPEARED, GONE, FREE]
    scene.store.start_over()
    page.wait_for("return document.getElementById('layer-stored').parentElement.hidden")


def test_what_changed_since_a_moment_is_a_layer(page, scene, live):
    only_the_map(page, "change")
    page.wait_for("return document.querySelectorAll('.change-part').length === 2")
    wall_x_m, column = scene.half_x_m - CELL_M / 2, round(scene.half_x_m / CELL_M) - 1 - 2 * EDGE
    cells = next(t for t in scene.tiles() if (t.ix, t.iy) == (2, 0)).cells.copy()
    assert cells[20, column] == OCCUPIED
    cells[20, column], cells[30, column - 10] = 0, 100
    scene.store.update([TileUpdate(0, 2, 0, scene.store.version + 1, CELL_M, cells)])
    page.wait_for("const c = corridor.report().change; return c.appeared === 1 && c.gone === 1")
    appeared, gone = page.texts(".change-part")
    assert appeared.endswith(": 1 cell")
    assert gone == "Free since then: 1 cell"
    was, new = (wall_x_m, 20.5 * CELL_M), (wall_x_m - 10 * CELL_M, 30.5 * CELL_M)
    assert pixels(page, *was, 200.0, was, new, (wall_x_m, 21.5 * CELL_M)) == [GONE, APPEARED, WALL]
    assert pixels(page, *new, 4.0) == [APPEARED]  # a cell is a fifth of a pixel
    page.run("document.getElementById('change-now').click()")
    assert page.report()["change"] == {"appeared": 0, "gone": 0}


LOOP_S = 0.35  # processor time of the loop below on this machine, where no host slows it down


def test_the_page_is_open_within_a_second_of_a_phones_processor(page, live):
    """A quarter of this machine's speed; the files are in the browser's cache. Here: 0.09 to 0.16 s.

    Its host may be slower at times, which a loop shows. The best of three.
    """
    opened_s, loop_s = [], []
    for _ in range(3):
        page.driver.get("about:blank")
        before_s = page.thread_s()
        page.driver.get(live.address)
        page.wait_for("return window.corridor?.view.firstMap_ms > 0")
        opened_s.append(page.thread_s() - before_s)
        before_s = page.thread_s()
        page.run("let x = 1; for (let k = 0; k < 3e7; k++) x = (x * 48271) % 2147483647; return x")
        loop_s.append(page.thread_s() - before_s)
    assert min(opened_s) < 1.0 / 4 * max(1.0, min(loop_s) / LOOP_S)
    fetched, found_late = page.run(
        "const got = performance.getEntriesByType('resource').filter((r) => /[.](js|css)$/.test(r.name));"
        "const links = [...document.querySelectorAll('link[rel=modulepreload]')].map((link) => link.href);"
        "return [got.filter((r) => r.transferSize > 0).map((r) => r.name),"
        " got.map((r) => r.name).filter((name) => name.endsWith('.js') && !links.includes(name))]"
    )
    assert fetched == []
    assert found_late == []  # all modules are fetched at once


def test_poses_of_two_lasers_at_one_moment_are_of_one_run(still):
    kept = still.of_module(
        "geometry.js",
        "((track) => { a[0].forEach((pose) => track.add(pose)); return track.poses.map((p) => p.number); })"
        "(new m.PoseTrack())",
        [{"number": k, "stamp_s": stamp_s} for k, stamp_s in enumerate((5.0, 1.0, 1.5, 1.5, 2.0))],
    )
    assert kept == [1, 3, 4]  # the first is of another run


def test_keys_and_mouse_move_zoom_and_turn_the_map(still):
    canvas = still.element("map")
    still.look_at(0.0, 0.0, 40.0)
    for key, camera in (
        (Keys.ARROW_RIGHT, [1.5, 0.0, 40.0, 0.0]),
        (Keys.ARROW_UP, [1.5, 1.5, 40.0, 0.0]),
        ("+", [1.5, 1.5, 50.0, 0.0]),
        ("[", [1.5, 1.5, 50.0, math.pi / 12]),
        ("n", [1.5, 1.5, 50.0, 0.0]),
        ("-", [1.5, 1.5, 40.0, 0.0]),
    ):
        canvas.send_keys(key)
        assert still.run(CAMERA) == pytest.approx(camera), key
    for key, is_on in (("", "false"), ("f", "true")):
        canvas.send_keys(key)
        assert still.element("follow").get_attribute("aria-pressed") == is_on
    still.look_at(0.0, 0.0, 40.0)
    still.pointer().drag_and_drop_by_offset(canvas, -80, 40).perform()
    assert still.run(CAMERA)[:2] == pytest.approx([2.0, 1.0])
    under = still.run("return corridor.view.camera.toMap(100, 300)")
    still.run(
        "document.getElementById('map').dispatchEvent(new WheelEvent('wheel',"
        "{deltaY: -300, clientX: arguments[0], clientY: arguments[1], cancelable: true}))",
        canvas.rect["x"] + 100,
        canvas.rect["y"] + 300,
    )
    assert still.run(CAMERA)[2] > 50.0
    assert still.run("return corridor.view.camera.toMap(100, 300)") == pytest.approx(under, abs=0.02)


def test_a_distance_is_measured_by_two_clicks(still):
    still.look_at(0.0, 0.0, 40.0)
    still.element("measure").click()
    canvas = still.element("map")
    for dx, dy in ((0, 0), (120, 160)):
        still.pointer().move_to_element_with_offset(canvas, dx, dy).click().perform()
    still.wait_for_text("hint", "5.00 m (x 3.00 m, y -4.00 m)")
    canvas.send_keys(Keys.ESCAPE)
    assert not still.element("hint").is_displayed()


def test_a_picture_is_rendered_within_a_frame_on_a_phones_processor(still):
    """A quarter of this machine's speed; 60 pictures a second leave 16.7 ms for each. Here: 0.7 to 1.1 ms."""
    median_ms = still.driver.execute_async_script(
        "const done = arguments[0], v = corridor.view; v.follow(false); v.render_ms.length = 0;"
        "const step = () => { v.camera.panBy(6, 3); v.invalidate();"
        " if (v.render_ms.length < 30) requestAnimationFrame(step);"
        " else done(v.render_ms.toSorted((a, b) => a - b)[15]); }; step();"
    )
    assert 4 * median_ms < 16.7
