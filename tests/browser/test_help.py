"""The manual beside the page: every status leads to the page that explains it."""

from service.encoding import encode_diagnostics
from tests.browser.conftest import DESKTOP, PHONE
from tests.browser.scene import stamp, statuses


def test_every_status_leads_to_a_page_and_a_heading_that_there_are(still):
    addresses = still.of_module(
        "health.js",
        "[...Object.keys(m.PAGES), 'sensor/front', 'anything'].map((name) => m.helpAddress(name))",
    )
    missing = still.driver.execute_async_script(
        "const [addresses, done] = arguments; Promise.all(addresses.map(async (address) => {"
        " const [path, anchor] = address.split('#'), answer = await fetch(path), text = await answer.text();"
        ' return answer.ok && (!anchor || text.includes(`id="${anchor}"`)) ? [] : [address];'
        "})).then((missing) => done(missing.flat()))",
        addresses,
    )
    assert missing == []


def test_a_sensor_in_fault_links_to_its_page_of_the_manual(still):
    rear = still.driver.find_element("xpath", "//section[@id='information']//button[contains(., 'rear')]")
    rear.click()
    for row in (".details", ".words:not(.details)"):
        link = still.driver.find_element("css selector", f"{row}:not([hidden]) a")
        assert link.get_attribute("href").endswith("/help/reason/link_down")
        assert link.accessible_name == "Manual: sensor/rear"
    rear.click()


def test_the_link_of_mapping_follows_its_reason(page, serve, scene):
    server = serve()
    page.open(server.address)
    for reason in ("laser_covered", "drift"):
        rows = statuses("degraded", "hardly a return")
        next(row for row in rows if row.name == "mapping").values["reason_id"] = reason
        server.put(encode_diagnostics("diagnostics", rows, stamp(1.0), stamp(1.0)))
        page.wait_for(
            "return document.querySelector('[aria-label=\"Manual: mapping\"]')?.href.endsWith(arguments[0])",
            f"/help/reason/{reason}",
        )
    page.driver.get(f"{server.address}help/reason/drift")
    assert page.driver.current_url.endswith("/help/mapping.md#drift")
    assert page.run("return document.querySelector('tr:target').innerText").startswith("drift")


def test_axe_finds_nothing_serious_in_the_manual(axe, page, serve):
    server = serve()
    for name, size, is_dark in (("", DESKTOP, False), ("operations.md", PHONE, True)):
        page.driver.get(f"{server.address}help/{name}")
        page.wait_for("return document.querySelector('h1') && document.documentElement.dataset.theme")
        axe(page, sizes=[size], schemes=[is_dark])
