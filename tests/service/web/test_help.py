"""The manual that is served with the page."""

from html.parser import HTMLParser
from posixpath import dirname, join, normpath

from service.outputs import REASON_PLACES
from service.web.help import INDEX, Manual
from tests.service.web.conftest import talk

THERE = ("help", "help/", "help/operator.md", "help/devices/sick_lms100.md", "help/images/rerun.png")
NOT_THERE = ("help/..%2f..%2fpyproject.toml", "help/%2e%2e/README.md", "help//etc/passwd", "help/none.md")


class Found(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.targets: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.ids |= {given["id"]} if "id" in given else set()
        self.targets |= {given[key] for key in ("href", "src") if given.get(key)}


def test_every_link_and_picture_of_every_page_is_served():
    manual = Manual()
    found = {name: Found(manual.render(name)) for name in manual.pages}
    assert len(found) > 60
    count = 0
    for name, page in found.items():
        for target in page.targets:
            if target.startswith(("http://", "https://", "/")):
                continue
            place, _, anchor = target.partition("#")
            path = normpath(join(dirname(name), place)) if place else name
            path = path if path in manual.files else join(path, INDEX)
            assert path in manual.files, f"{name}: {target}"
            assert not anchor or anchor in found[path].ids, f"{name}: {target}"
            count += 1
    assert count > 300


def test_every_reason_has_a_row_of_the_manual():
    manual = Manual()
    rows = {page: Found(manual.render(page)).ids for page in ("mapping.md", "operations.md")}
    assert len(REASON_PLACES) > 40
    for reason, place in REASON_PLACES.items():
        page, _, anchor = place.partition("#")
        assert anchor in rows[page], f"{reason}: docs/{page} has no row of it in a table of reason ids"


def test_html_in_a_page_is_shown_as_text_and_links_that_lead_elsewhere_are_plain(tmp_path):
    (tmp_path / "README.md").write_text(
        "# A <b>page</b>\n\n<script>alert(1)</script> [out](../secret.md) [js](javascript:alert(1)) "
        "[there](https://example.com) [here](#a-bpageb)\n"
    )
    text = Manual(tmp_path).render("README.md")
    main = text.partition("<main>")[2]
    assert "<script>" not in main
    assert "&lt;script&gt;" in main
    assert Found(main).targets == {"https://example.com", "#a-bpageb"}
    assert "out" in main


def test_only_files_of_the_manual_are_served(serve):
    server = serve()

    facts = {}

    async def look(client):
        for path in (*THERE, *NOT_THERE):
            async with client.session.get(f"{client.address}{path}") as response:
                facts[path] = response.status, response.content_type
        for reason in ("drift", "unheard-of"):
            there = f"{client.address}help/reason/{reason}"
            async with client.session.get(there, allow_redirects=False) as response:
                facts[reason] = response.headers["Location"]

    talk(server, look)
    assert [facts[path][0] for path in THERE] == [200] * len(THERE)
    assert facts["help/images/rerun.png"][1] == "image/png"
    assert facts["drift"] == "/help/mapping.md#drift"
    assert facts["unheard-of"] == "/help/operations.md#health"
    assert [facts[path][0] for path in NOT_THERE] == [404] * len(NOT_THERE)
