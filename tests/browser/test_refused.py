"""A control that would be refused is disabled, and says why to whoever points at it or hears the page."""

import pytest

from service.mapstore.files import save_map
from tests.browser.conftest import begin_live, store_map
from tests.browser.pictures import VERBS
from tests.browser.test_control import put_health
from tests.service.sinks.test_map_saver import tile
from tests.service.web.conftest import TOKEN

AREAS = ("information", "control", "edit", "resources")
SILENT = (  # controls that are shown, disabled and without a reason; that of a fieldset counts for all in it
    "const reason = (node) => node && (node.title || (node.getAttribute('aria-describedby') ?? '').split(' ')"
    ".map((id) => document.getElementById(id)?.textContent ?? '').join(''));"
    "return [...document.querySelectorAll('button, input, select')].filter((c) => c.offsetParent"
    " && c.matches(':disabled') && !reason(c) && !reason(c.closest('fieldset:disabled')))"
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
        begin_live(serve(folders={"session": maps / "none", "map": maps}), scene, page, token)
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


def test_without_the_token_every_control_names_it_as_the_reason(stocked):
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


def test_a_result_shows_no_empty_card_and_no_area_without_content(page, opened, folder):
    opened(folder)
    page.choose("control")
    titles = (
        "return [...document.querySelectorAll('#control .card')].filter((c) => c.offsetParent)"
        ".map((c) => [c.firstChild.firstChild.textContent, c.children.length])"
    )
    assert all(count > 1 for _, count in page.run(titles))
    assert [title for title, _ in page.run(titles)] == ["Access"]
    for area in ("resources", "history"):
        assert not page.element(f"tab-{area}").is_displayed()
    page.choose("information")
    assert page.texts("#information dl:not([hidden]) dt") == []  # of a pose
    assert not any(silent(page).values())
    assert page.texts(".notice") == []
    assert page.faults() == []
