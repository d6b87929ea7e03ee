"""The manual beside the page: every status leads to the page that explains it."""

from tests.browser.conftest import DESKTOP, PHONE


def test_every_status_leads_to_a_page_and_a_heading_that_there_are(still):
    missing = still.driver.execute_async_script(
        "const done = arguments[0]; (async () => {"
        " const {PAGES, helpAddress} = await import('./help_links.js'), missing = [];"
        " for (const status of [...Object.keys(PAGES), 'sensor/front', 'anything']) {"
        "  const [path, anchor] = helpAddress(status).split('#'), answer = await fetch(path);"
        "  const text = answer.ok ? await answer.text() : '';"
        '  if (!text || (anchor && !text.includes(`id="${anchor}"`))) missing.push(status);'
        " } return missing; })().then(done)"
    )
    assert missing == []


def test_a_sensor_in_fault_links_to_its_page_of_the_manual(still):
    rear = still.driver.find_element("xpath", "//section[@id='information']//button[contains(., 'rear')]")
    rear.click()
    link = still.driver.find_element("css selector", ".details:not([hidden]) a")
    assert link.get_attribute("href").endswith("/help/doctor.md")
    assert link.accessible_name == "Manual: sensor/rear"
    rear.click()


def test_axe_finds_nothing_serious_in_the_manual(axe, page, serve):
    server = serve()
    for name, size, is_dark in (("", DESKTOP, False), ("operations.md", PHONE, True)):
        page.driver.get(f"{server.address}help/{name}")
        page.wait_for("return document.querySelector('h1') && document.documentElement.dataset.theme")
        axe(page, sizes=[size], schemes=[is_dark])
