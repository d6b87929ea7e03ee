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
MAPPED = {"state": "ok", "mode": "mapping"}
STATES = {  # mapping's values, and those of recording
    "waiting": ({}, "stopped"),
    "well": (MAPPED, "recording"),
    "lost": ({**MAPPED, "state": "lost"}, "stopped"),
    "paused": ({**MAPPED, "state": "paused"}, "recording"),
    "localised": ({"state": "ok", "mode": "localization"}, "recording"),
    "fixed": ({"state": "ok", **dict.fromkeys(("mode", "configured_mode"), "localization")}, "recording"),
    "another profile": ({**MAPPED, "profile": "imle"}, "recording"),
}
NO_GRAPH = "It holds a picture without key frames: no session can begin in it"
REASONS = {  # of a control in a state: part of its title, or "" where it works
    ("well", "do-save_map"): "",
    ("well", "Load\u2026 office"): "",
    ("well", "Load\u2026 picture"): NO_GRAPH,
    ("fixed", "do-set_mode"): "change it and start the service again",
    ("fixed", "do-switch_profile"): "mode: localization",
    ("waiting", "do-save_map"): "begins with the first scan",
    ("another profile", "Load\u2026 office"): "The profile imle begins in no stored map; corridor does",
}


@pytest.fixture
def stocked(page, serve, scene, tmp_path):
    """A page of a running session; a map and a picture are stored."""

    def begin(token):
        store_map(tmp_path / "office")
        save_map(tmp_path / "picture", [tile(1)], 1)
        begin_live(serve(folders={"session": tmp_path / "none", "map": tmp_path}), scene, page, token)
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
    why = "Only with the token: enter it under Control"
    assert page.element("do-reset_map").get_attribute("title") == why


def test_no_control_is_disabled_without_its_reason_and_reasons_name_what_to_do(stocked):
    page = stocked(TOKEN)
    control = (
        "const c = document.querySelector(`#${CSS.escape(arguments[0])}, [aria-label='${arguments[0]}']`);"
    )
    for name, health in STATES.items():
        put_health(page, *health)
        assert not any(silent(page).values()), name
        page.choose("resources")
        page.run("document.getElementById('refresh').click()")
        page.wait_for_answers()
        for (state, label), why in REASONS.items():
            if state == name:
                is_disabled, title = page.run(f"{control} return [c.disabled, c.title]", label)
                assert is_disabled == bool(why), (name, label)
                assert why in title, (name, label)


def test_a_result_shows_no_empty_card_and_no_area_without_content(page, opened, folder):
    opened(folder)
    page.choose("control")
    titles = page.run(
        "return [...document.querySelectorAll('#control .card')].filter((c) => c.offsetParent)"
        ".map((c) => [c.firstChild.firstChild.textContent, c.children.length > 1])"
    )
    assert titles == [["Access", True]]
    for area in ("resources", "history"):
        assert not page.element(f"tab-{area}").is_displayed()
    page.choose("information")
    assert page.texts("#information dl:not([hidden]) dt") == []  # of a pose
    assert not any(silent(page).values())
    assert page.texts(".notice") == []
    assert page.faults() == []
