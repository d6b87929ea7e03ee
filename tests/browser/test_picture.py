"""The map as one would print it: metres along its edges, an arrow to the north, a scale, a PNG file."""

import base64
import io
import math

import pytest
from PIL import Image

CALLS = (  # of a function of map_frame.js on a context that notes its texts and its xs
    "((camera) => { const words = [], xs = [], {colours} = corridor.view;"
    " const nothing = () => {}, before = {...camera};"
    " Object.assign(camera, {x_m: 0, y_m: 0, scale: 37, rotation_rad: a[0]});"
    " const x = (sx) => xs.push(sx);"
    " const fillText = (text, sx, sy) => words.push([text, ...camera.toMap(sx, sy)]);"
    " const context = {strokeText: nothing, fillText, fillRect: nothing, beginPath: nothing, stroke: nothing,"
    "  measureText: () => ({width: 20}), moveTo: x, lineTo: x};"
    " m[a[1]](context, camera, colours, 5); Object.assign(camera, before);"
    " return [words, Math.max(...xs) - Math.min(...xs)]; })(corridor.view.camera)"
)


@pytest.mark.parametrize("turn_rad", [0.0, 0.4, math.pi / 2, -2.0, math.pi])
def test_metres_along_the_edges_stand_at_their_lines(still, turn_rad):
    found, _ = still.of_module("map_frame.js", CALLS, turn_rad, "drawMetres")
    axes = set()
    for words, x_m, y_m in found:
        axis, at_m = words.split()
        axes.add(axis)
        assert {"x": x_m, "y": y_m}[axis] == pytest.approx(float(at_m), abs=1e-9)
    assert axes == {"x", "y"}
    assert len(found) >= 4


def test_the_scale_bar_is_as_long_as_it_says(still):
    ((words, *_),), length = still.of_module("map_frame.js", CALLS, 0.0, "drawScale")
    assert (words, length) == ("2 m", pytest.approx(2 * 37.0))


def test_the_arrow_points_north_where_the_map_lies_on_the_earth(still):
    norths = still.of_module(
        "map_frame.js",
        "[null, {}, {map_yaw_enu_deg: '0.00'}, {map_yaw_enu_deg: '90.00'}]"
        ".map((values) => m.northOf(values && {statuses: [{values: {}}, {values}]}))",
    )
    # a map whose x axis lies to the north has north along it
    assert norths == [None, None, pytest.approx(math.pi / 2), pytest.approx(0.0)]


def test_a_picture_is_the_view_with_its_scale_as_a_png(still):
    still.look_at(0.0, 0.0, 40.0)
    wall, free = still.pixel(7.98, 0.0), still.pixel(5.1, 3.1)
    x, y = still.run("return corridor.view.camera.toScreen(7.98, 0.0).map(Math.floor)")
    data = still.of_module(
        "map_frame.js",
        "await new Promise(async (read) => {"
        " const reader = new FileReader(); reader.onload = () => read(reader.result);"
        " reader.readAsDataURL(await m.pictureOf(corridor.view, 'veh1, 2026-01-01')); })",
    )
    kind, _, body = data.partition(",")
    assert kind == "data:image/png;base64"
    with Image.open(io.BytesIO(base64.b64decode(body))) as picture:
        size = still.run("return [corridor.view.canvas.width, corridor.view.canvas.height + 26]")
        assert list(picture.size) == size
        assert list(picture.convert("RGB").getpixel((x, y))) == wall != free


def test_one_click_saves_the_picture_under_the_name_of_the_vehicle(still):
    still.run(
        "window.saved = null;"
        "HTMLAnchorElement.prototype.click = function () { window.saved = this.download; }"
    )
    still.element("picture").click()
    name = still.wait_for("return window.saved")
    assert name.startswith(f"{still.text('vehicle')}_2")
    assert name.endswith("Z.png")
    still.run("delete HTMLAnchorElement.prototype.click")
