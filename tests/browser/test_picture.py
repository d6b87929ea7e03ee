"""The map as one would print it: metres along its edges, an arrow to the north, a PNG file."""

import base64
import io
import math

import pytest
from PIL import Image

METRES = (
    "const [turn, done] = arguments; import('./map_frame.js').then(({drawMetres}) => {"
    " const {camera, colours} = corridor.view, before = camera.rotation_rad, found = [];"
    " camera.rotation_rad = turn; camera.centreOn(0, 0); camera.scale = 40;"
    " const fillText = (words, sx, sy) => found.push([words, ...camera.toMap(sx, sy)]);"
    " drawMetres({strokeText() {}, fillText},"
    "  camera, colours, 5); camera.rotation_rad = before; done(found); })"
)


@pytest.mark.parametrize("turn_rad", [0.0, 0.4, math.pi / 2, -2.0, math.pi])
def test_metres_along_the_edges_stand_at_their_lines(still, turn_rad):
    found = still.driver.execute_async_script(METRES, turn_rad)
    axes = set()
    for words, x_m, y_m in found:
        axis, at_m = words.split()
        axes.add(axis)
        assert {"x": x_m, "y": y_m}[axis] == pytest.approx(float(at_m), abs=1e-9)
    assert axes == {"x", "y"}
    assert len(found) >= 4


def test_the_arrow_points_north_where_the_map_lies_on_the_earth(still):
    norths = still.driver.execute_async_script(
        "const done = arguments[0]; import('./map_frame.js').then(({northOf}) => {"
        " const health = (values) => ({statuses: [{values: {}}, {values}]});"
        " done([northOf(null), northOf(health({})), northOf(health({map_yaw_enu_deg: '0.00'})),"
        "  northOf(health({map_yaw_enu_deg: '90.00'}))]); })"
    )
    # a map whose x axis lies to the north has north along it
    assert norths == [None, None, pytest.approx(math.pi / 2), pytest.approx(0.0)]


def test_a_picture_is_the_view_with_its_scale_as_a_png(still):
    still.look_at(0.0, 0.0, 40.0)
    wall, free = still.pixel(7.98, 0.0), still.pixel(5.1, 3.1)
    x, y = still.run("return corridor.view.camera.toScreen(7.98, 0.0).map(Math.floor)")
    data = still.driver.execute_async_script(
        "const done = arguments[0]; import('./map_frame.js').then(async ({pictureOf}) => {"
        " const reader = new FileReader(); reader.onload = () => done(reader.result);"
        " reader.readAsDataURL(await pictureOf(corridor.view, 'veh1, 2026-01-01')); })"
    )
    kind, _, body = data.partition(",")
    assert kind == "data:image/png;base64"
    with Image.open(io.BytesIO(base64.b64decode(body))) as picture:
        assert picture.size == tuple(
            still.run("return [corridor.view.canvas.width, corridor.view.canvas.height + 26]")
        )
        assert list(picture.convert("RGB").getpixel((x, y))) == wall != free


def test_one_click_saves_the_picture_under_the_name_of_the_vehicle(still):
    still.run(
        "window.saved = null;"
        "HTMLAnchorElement.prototype.click = function () { window.saved = this.download; }"
    )
    still.element("picture").click()
    name = still.wait_for("return window.saved")
    vehicle = still.text("vehicle")
    assert name.startswith(f"{vehicle}_2")
    assert name.endswith("Z.png")
    still.run("delete HTMLAnchorElement.prototype.click")
