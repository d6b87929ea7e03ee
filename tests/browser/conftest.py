"""Chromium without a window, on a page that a test feeds; skips with the command that provides it."""

import json
import os
import shutil
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from functools import partial
from itertools import cycle, islice, product
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

from service.mapstore.files import save_map
from service.mapstore.graph_files import GRAPH_FILE
from service.mapstore.links import CURRENT
from service.offline.past.view import View
from tests.browser.scene import Scene
from tests.service.offline.conftest import bent, bent_folder, folder  # noqa: F401 - fixtures
from tests.service.sinks.test_map_saver import tile
from tests.service.web.conftest import (
    TIMEOUT_S,
    TOKEN,
    FakeDispatcher,
    dispatcher,  # noqa: F401 - a fixture
    served,
    store,  # noqa: F401 - a fixture
)

ROOT = Path(__file__).parents[2]
AXE = Path(os.environ.get("CORRIDOR_AXE", ROOT / "build/node_modules/axe-core/axe.min.js"))
LOOK_S = 0.05  # between two looks at the page; the browser has no event for a change
HEADLESS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage")  # and for root
ARGUMENTS = (  # nothing of its own on the network
    *(*HEADLESS, "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic"),
    # One process renders all pages: each start of another, in use or as a spare, takes 0.2 s of processor.
    *("--renderer-process-limit=1", "--disable-site-isolation-trials", "--disable-extensions"),
    "--disable-features=SpareRendererForSitePerProcess",
)
FIRST_PORT, PORTS = 20_000, 6_000  # none that a system hands out by itself
DESKTOP, PHONE = (1280, 800), (390, 844)
WIDE_CARDS = "[...document.querySelectorAll('.card')].filter((c) => c.scrollWidth > c.clientWidth)"


class Page:
    """The page in a browser, and its operation."""

    def __init__(self, driver: webdriver.Chrome) -> None:
        self.driver = driver

    def open(self, address: str, token: str = "") -> None:
        self.driver.get(address + (f"#token={token}" if token else ""))
        self.wait_for("return window.corridor !== undefined && corridor.report().isOpen")

    def run(self, script: str, *arguments: Any) -> Any:
        return self.driver.execute_script(script, *arguments)

    def wait_for(self, script: str, *arguments: Any) -> Any:
        """Until the script returns something true; that."""
        return WebDriverWait(self.driver, TIMEOUT_S, LOOK_S).until(
            lambda driver: driver.execute_script(script, *arguments), f"never true: {script}"
        )

    def of_module(self, name: str, expression: str, *arguments: Any) -> Any:
        """An expression of what a module of the page exports, `m`, and of the arguments, `a`; may await."""
        return self.driver.execute_async_script(
            "const [...a] = arguments, done = a.pop();"
            f"import('./{name}').then(async (m) => done({expression}))",
            *arguments,
        )

    def report(self) -> dict[str, Any]:
        return dict(self.run("return corridor.report()"))

    def element(self, name: str) -> WebElement:
        return self.driver.find_element("id", name)

    def text(self, name: str) -> str:
        return str(self.run("return document.getElementById(arguments[0]).textContent", name))

    def wait_for_text(self, name: str, text: str) -> None:
        self.wait_for(
            "return document.getElementById(arguments[0]).textContent.includes(arguments[1])", name, text
        )

    def wait_for_answers(self) -> None:
        """Until every command of the page is answered."""
        self.wait_for("return corridor.connection.waiting.size === 0")

    def count_presses(self) -> None:
        """From the area Information on, with mouse or finger; see `presses`."""
        self.choose("information")
        self.run(
            "window.presses = 0;"
            "window.countPress ??= addEventListener('pointerdown', () => { window.presses += 1; }, true) ?? 1"
        )

    def presses(self) -> int:
        return int(self.run("return window.presses"))

    def pointer(self) -> ActionChains:
        """Moves at once; selenium's own quarter of a second sends and renders a dozen places between."""
        return ActionChains(self.driver, duration=0)

    def texts(self, selector: str) -> list[str]:
        """Of all elements that it selects."""
        return list(
            self.run(
                "return [...document.querySelectorAll(arguments[0])].map((e) => e.textContent)", selector
            )
        )

    def press(self, label: str) -> None:
        """The button with that accessible name."""
        self.driver.find_element("css selector", f'[aria-label="{label}"]').click()

    def answer(self, choice: str = "yes") -> None:
        """Wait for a question, and press one of its buttons."""
        is_open = "document.getElementById('confirm').open"
        self.wait_for(f"return {is_open}")
        self.element(f"confirm-{choice}").click()
        self.wait_for(f"return !{is_open}")

    def put(self, name: str, value: str) -> None:
        """Into a slider or a choice, as a hand does."""
        self.run(
            "const control = document.getElementById(arguments[0]); control.value = arguments[1];"
            "for (const kind of ['input', 'change']) control.dispatchEvent(new Event(kind))",
            name,
            value,
        )

    def redraw(self) -> None:
        """Render the map again, and wait for that."""
        before = self.run("corridor.view.invalidate(); return corridor.view.frames")
        self.wait_for("return corridor.view.frames > arguments[0]", before)

    def choose(self, area: str) -> None:
        self.element(f"tab-{area}").click()

    def look_at(self, x_m: float, y_m: float, pixels_per_m: float) -> None:
        """Bring a point of the map to the middle, and wait until it is rendered."""
        self.run(
            "const v = corridor.view; v.follow(false); v.camera.centreOn(arguments[0], arguments[1]);"
            "v.camera.scale = arguments[2]; window.frameBefore = v.frames; v.invalidate()",
            x_m, y_m, pixels_per_m,
        )  # fmt: skip
        self.wait_for("return corridor.view.frames > window.frameBefore")

    def pixel(self, x_m: float, y_m: float) -> list[int]:
        """Red, green, blue at a point of the map."""
        return list(
            self.run(
                "const v = corridor.view, [x, y] = v.camera.toScreen(arguments[0], arguments[1]);"
                "return [...v.context.getImageData(x * v.dpr, y * v.dpr, 1, 1).data].slice(0, 3)",
                x_m,
                y_m,
            )
        )

    def thread_s(self) -> float:
        """Processor time of the thread that runs and renders the page: other programs hardly change it."""
        self.driver.execute_cdp_cmd("Performance.enable", {"timeDomain": "threadTicks"})
        metrics = self.driver.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]
        return float(next(metric["value"] for metric in metrics if metric["name"] == "ThreadTime"))

    def leave(self) -> None:
        """Clears what the browser stored of the page."""
        self.run("try { sessionStorage.clear(); localStorage.clear(); } catch { /* no page was opened */ }")
        self.driver.get("about:blank")
        self.driver.get_log("browser")

    def faults(self) -> list[str]:
        """Errors and warnings of the browser."""
        return [entry["message"] for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]

    def resize(self, size: tuple[int, int], is_dark: bool = False) -> None:
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size[0] < 600}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        theme = "dark" if is_dark else "light"
        scheme = {"name": "prefers-color-scheme", "value": theme}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
        self.wait_for(
            "return [undefined, arguments[0]].includes(document.documentElement.dataset.theme)", theme
        )


def start_chromium(arguments: Sequence[str]) -> webdriver.Chrome:
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or "chromium"
    for argument in arguments:
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    return webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver") or "chromedriver"))


@pytest.fixture(scope="session")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[webdriver.Chrome]:
    if not (shutil.which("chromium") and shutil.which("chromedriver")):
        pytest.skip("no Chromium with its driver; with them: sudo apt install chromium chromium-driver")
    driver = start_chromium([*ARGUMENTS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"])
    yield driver
    driver.quit()


@pytest.fixture
def page(chromium: webdriver.Chrome) -> Iterator[Page]:
    """Of desktop size, light; a browser that remembers nothing."""
    opened = Page(chromium)
    if chromium.current_url.startswith("http"):
        opened.leave()  # one that is shared
    opened.resize(DESKTOP)
    yield opened
    opened.leave()


@pytest.fixture
def share(request: pytest.FixtureRequest, chromium: webdriver.Chrome) -> Iterator[Callable[..., Page]]:
    """Opens a page, or goes on with it where the test before has shared it; half a second of processor less.

    A test that shares one sets it up at its begin, and leaves nothing that others would see.
    """
    failed_before = request.session.testsfailed
    shared = Page(chromium)
    shared.resize(DESKTOP)

    def begin(address: str, open_it: Callable[[Page], None]) -> Page:
        if not chromium.current_url.startswith(address.partition("#")[0]):
            shared.leave()
            open_it(shared)
        return shared

    yield begin
    chromium.get_log("browser")
    if request.session.testsfailed > failed_before:
        shared.leave()  # a test that failed may have left anything there


@pytest.fixture(scope="session")
def address() -> str:
    """Where the page of each test is in turn: of one address, the browser compiles it only once."""
    first = FIRST_PORT + os.getpid() % PORTS  # tests that run at the same time have others
    for port in range(first, first + PORTS):
        with suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return f"127.0.0.1:{port}"
    raise AssertionError(f"no port from {first} on is free")


@pytest.fixture
def serve(store: Any, dispatcher: FakeDispatcher, address: str) -> Iterator[Callable[..., Any]]:  # noqa: F811
    """Starts the page, one in a test."""
    with served(store, dispatcher.answer) as start:
        yield partial(start, listen=address)


@pytest.fixture
def scene(store: Any) -> Scene:  # noqa: F811
    made = Scene(store=store)
    made.map_all()
    return made


def stores(root: Path) -> dict[str, Path]:
    """Where sessions and maps would be."""
    return {"session": root / "sessions", "map": root / "maps"}


def begin_live(server: Any, scene: Scene, page: Page, token: str = TOKEN, verbs: Sequence[str] = ()) -> None:
    """The scene's second 1, open in the browser; with these verbs instead of the server's own."""
    for message in scene.messages(1.0):
        server.put(message)
    page.open(server.address, token)
    page.wait_for(
        "const r = corridor.report();"
        "return r.tiles > 0 && r.pose && r.health && r.mayControl === arguments[0]",
        token == TOKEN,
    )
    if verbs:
        page.run("corridor.connection.on.verbs({verbs: arguments[0]})", verbs)


@pytest.fixture
def live(serve: Callable[..., Any], scene: Scene, page: Page, tmp_path: Path) -> Any:
    """A service at the scene's second 1, open in the browser with the token."""
    server = serve(folders=stores(tmp_path))
    begin_live(server, scene, page)
    return server


def requested(fake: FakeDispatcher) -> list[tuple[str, Any]]:
    """Verb and request of each command that came."""
    return [(verb, json.loads(payload)) for verb, payload in fake.requested]


@pytest.fixture(scope="session")
def still_dispatcher() -> FakeDispatcher:
    return FakeDispatcher()


@pytest.fixture(scope="session")
def still_server(still_dispatcher: FakeDispatcher, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    scene = Scene()
    scene.map_all()
    with served(scene.store, still_dispatcher.answer) as start:
        yield start(folders=stores(tmp_path_factory.mktemp("stored")))


@pytest.fixture
def still(share: Callable[..., Page], still_server: Any) -> Page:
    """A page as `live` has it, shared: nothing more comes to it. Its area Information is shown."""
    page = share(still_server.address, lambda page: begin_live(still_server, Scene(), page))
    page.choose("information")
    return page


@pytest.fixture
def opened(page: Page, address: str) -> Iterator[Callable[..., View]]:
    """Opens a stored map on the page, its area Edit shown; closes it again."""
    with ExitStack() as stack:

        def open_one(source: Path, version: int = 1) -> View:
            view = stack.enter_context(closing(View(source, address)))
            open_view(page, view, version)
            return view

        yield open_one


def open_view(page: Page, view: View, version: int = 1) -> None:
    page.open(view.address)
    page.wait_for(
        "const r = corridor.report(); return r.tiles > 0 && r.mayControl && r.health"
        " && corridor.edit.version === arguments[0]",
        version,
    )
    page.choose("edit")


@pytest.fixture
def axe() -> Callable[..., None]:
    """Judges a page in each area, in the first size and scheme and in the second ones: all fits the width,
    and axe-core finds nothing serious.

    areas    to be chosen; none: the page as it is
    shown    id of an element that must be displayed
    """
    if not AXE.is_file():
        pytest.skip("no axe-core; with it: make axe (npm fetches it)")
    source = AXE.read_text(encoding="utf-8")

    def judge(
        page: Page,
        *areas: str,
        sizes: Sequence[tuple[int, int]] = (DESKTOP, PHONE),
        schemes: Sequence[bool] = (False, True),
        shown: str = "",
    ) -> None:
        page.run(source)
        try:
            cases = islice(zip(cycle(sizes), cycle(schemes), strict=False), max(len(sizes), len(schemes)))
            for (size, is_dark), area in product(cases, areas or ("",)):
                page.resize(size, is_dark)
                if area:
                    page.choose(area)
                case = f"{area} {size}, dark: {is_dark}"
                assert page.run("return document.documentElement.scrollWidth") <= size[0], case
                assert page.run(f"return {WIDE_CARDS}.map((c) => c.innerText)") == [], case
                assert not shown or page.element(shown).is_displayed(), case
                assert serious_faults(page) == [], case
        finally:
            page.resize(DESKTOP)
        assert page.faults() == []

    return judge


def serious_faults(page: Page) -> list[tuple[str, list[str]]]:
    """What axe calls serious or critical, of what is shown."""
    result = page.driver.execute_async_script(
        "axe.run().then((found) => arguments[0](found), (error) => arguments[0]({error: String(error)}))"
    )
    assert "error" not in result
    assert len(result["passes"]) > 10
    return [
        (fault["id"], [node["html"] for node in fault["nodes"]])
        for fault in result["violations"]
        if fault["impact"] in ("serious", "critical")
    ]


def store_map(in_folder: Path) -> None:
    """One that a session can begin in, as far as the page looks into it."""
    save_map(in_folder, [tile(1)], 1)
    (in_folder / CURRENT / GRAPH_FILE).touch()
