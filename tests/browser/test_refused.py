"""A control that would be refused is disabled, and says why to whoever points at it or hears the page."""

import pytest

from service.mapstore.files import save_map
from service.offline.past.view import View
from tests.browser.conftest import store_map
from tests.browser.pictures import VERBS
from tests.browser.test_edit import opened  # noqa: F401 - a fixture
from tests.service.sinks.test_map_saver import tile
from tests.service.web.conftest import TOKEN

AREAS = ("information", "control", "edit", "resources")
SILENT = (  # controls that are shown, disabled and say nothing; of a fieldset, what is on top of it does
    "const said = (node) => node && (node.title || (node.getAttribute('aria-describedby') ?? '').split(' ')"
    ".map((id) => document.getElementById(id)?.textContent ?? '').join(''));"
    "return [...document.querySelectorAll('button, input, select')].filter((c) => c.offsetParent"
    " && c.matches(':disabled') && !said(c) && !said(c.closest('fieldset:disabled')))"
    ".map((c) => c.id || c.textContent)"
)
STATES = {  # mapping's values, and those of recording
    "waiting": ({}, "stopped"),
    "well": ({"state": "ok", "mode": "mapping"}, "recording"),
    "lost": ({"state": "lost", "mode": "mapping"}, "stopped"),
    "paused": ({"state": "paused", "mode": "mapping"}, "recording"),
    "localised": ({"state": "ok", "mode": "localization"}, "recording"),
    "localised for good": (
        {"state": "ok", "mode": "localization", "configured_mode": "localization"},
        "recording",
    ),
    "another profile": ({"state": "ok", "mode": "mapping", "profile": "imle"}, "recording"),
}


def put_health(page, values, recording):
    page.run(
        "const status = (name, values) => ({name, level: 0, message: 'ok', since_s: 0, values});"
        "corridor.connection.on.health({stamp_s: 1, latency_ms: {}, statuses: ["
        " status('mapping', arguments[0]), status('recording', {state: arguments[1]}),"
        " status('map', {folder: '/m/office'})]})",
        {"profile": "corridor", **values},
        recording,
    )


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    store_map(folder / "office")
    save_map(folder / "picture", [tile(1)], 1)
    return folder


@pytest.fixture
def stocked(page, serve, scene, maps):
    """A page of a running session with the token; a map and a picture are stored."""

    def begin(token=TOKEN):
        server = serve(folders={"session": maps / "none", "map": maps})
        for message in scene.messages(1.0):
            server.put(message)
        page.open(server.address, token)
        page.wait_for("const r = corridor.report(); return r.pose && r.health")
        page.run(
            "corridor.connection.on.hello({run_id: '', vehicle: 'v', verbs: arguments[0], stores: true,"
            " profile: 'corridor', profiles: ['corridor', 'imle']})",
            VERBS,
        )
        page.choose("resources")
        page.wait_for_text("resources", "picture")
        return page

    return begin


def silent(page):
    found = {}
    for area in AREAS:
        if page.element(f"tab-{area}").is_displayed():
            page.choose(area)
            found[area] = page.run(SILENT)
    return found


def test_whoever_may_not_reads_of_the_token(stocked):
    page = stocked(token="")
    put_health(page, *STATES["well"])
    assert not any(silent(page).values())
    page.choose("control")
    assert (
        page.element("do-reset_map").get_attribute("title") == "Only with the token: enter it under Control"
    )


def test_no_control_is_disabled_without_its_reason(stocked):
    page = stocked()
    for name, health in STATES.items():
        put_health(page, *health)
        assert not any(silent(page).values()), name


def title_of_load(page, name):
    page.choose("resources")
    return page.wait_for(
        "const load = document.querySelector(arguments[0]); return load && [!load.disabled, load.title]",
        f'[aria-label="Load\u2026 {name}"]',
    )


def test_reasons_name_what_to_do(stocked):
    page = stocked()
    put_health(page, *STATES["localised for good"])
    page.choose("control")
    assert "change it and start the service again" in page.element("do-set_mode").get_attribute("title")
    assert "mode: localization" in page.element("do-switch_profile").get_attribute("title")
    page.choose("edit")
    assert "change mode: localization in the config" in page.text("edit-note")
    put_health(page, *STATES["waiting"])
    page.choose("control")
    assert "begins with the first scan" in page.element("do-save_map").get_attribute("title")
    put_health(page, *STATES["well"])
    assert page.element("do-save_map").get_attribute("title") == ""
    assert title_of_load(page, "office") == [True, ""]
    is_enabled, why = title_of_load(page, "picture")
    assert not is_enabled
    assert "no session can begin in it" in why


def test_a_map_is_not_loaded_with_a_profile_that_begins_in_none(stocked):
    page = stocked()
    page.choose("resources")
    put_health(page, *STATES["another profile"])
    page.wait_for("return document.querySelector('[aria-label^=\"Load\"]').disabled")
    why = "The profile imle begins in no stored map; corridor does"
    assert title_of_load(page, "office") == [False, why]


def test_a_result_shows_no_empty_card_and_says_nothing_of_what_it_has_not(page, folder):
    view = View(folder, "127.0.0.1:0")
    try:
        page.open(view.address)
        page.wait_for("const r = corridor.report(); return r.tiles > 0 && r.mayControl && r.health")
        page.choose("control")
        titles = (
            "return [...document.querySelectorAll('#control .card')].filter((c) => c.offsetParent)"
            ".map((c) => [c.firstChild.firstChild.textContent, c.children.length])"
        )
        assert all(count > 1 for _, count in page.run(titles))
        assert [title for title, _ in page.run(titles)] == ["Access"]
        assert not page.element("tab-resources").is_displayed()
        assert not any(silent(page).values())
        assert page.run("return document.querySelectorAll('.notice').length") == 0
        assert page.faults() == []
    finally:
        view.close()
