"""The manual, served with the page: docs/*.md as HTML, offline. No request reads a file that is not of it."""

import asyncio
import html
import posixpath
import re
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from aiohttp import web
from markdown_it import MarkdownIt
from markdown_it.token import Token

from service.outputs import REASON_PLACES
from service.resources import DOCS

INDEX = "README.md"
KEPT_PAGES = 16  # as HTML
_IMAGES = {"png": "image/png"}
_PAGE = """<!doctype html>
<html lang="en">
<head>
  <meta charset="utf-8">
  <meta name="viewport" content="width=device-width, initial-scale=1">
  <meta name="color-scheme" content="light dark">
  <title>{title}</title>
  <link rel="icon" href="/icon.svg" type="image/svg+xml">
  <link rel="stylesheet" href="/page.css">
  <link rel="stylesheet" href="/help.css">
  <script type="module" src="/help.js"></script>
</head>
<body class="manual">
  <header class="bar">
    <nav aria-label="Manual"><a href="/">Map</a> <a href="/help/">Contents</a></nav>
    <button id="theme" type="button" class="quiet" aria-label="Colours: as the device says"></button>
  </header>
  <main>
{body}
  </main>
</body>
</html>
"""


class Manual:
    """Answers GET /help/ and what is below it."""

    def __init__(self, folder: Path = DOCS) -> None:
        self.files = {
            path.relative_to(folder).as_posix(): path
            for path in sorted(folder.rglob("*"))
            if path.suffix[1:] in ("md", *_IMAGES)
        }
        self._markdown = MarkdownIt("commonmark", {"html": False}).enable("table")
        self._rendered = lru_cache(KEPT_PAGES)(self.render)

    @property
    def pages(self) -> tuple[str, ...]:
        return tuple(name for name in self.files if name.endswith(".md"))

    def add_to(self, app: web.Application) -> None:
        app.router.add_get("/help", _to_contents)
        app.router.add_get("/help/reason/{reason}", _to_reason)
        app.router.add_get("/help/{name:.*}", self._answer)

    async def _answer(self, request: web.Request) -> web.Response:
        name = request.match_info["name"] or INDEX
        if name not in self.files:
            name = posixpath.join(name, INDEX)  # of a folder
        path = self.files.get(posixpath.normpath(name))
        if path is None:
            return web.Response(status=404, text="the manual has no such page; its contents: /help/\n")
        kind = path.suffix[1:]
        if kind in _IMAGES:
            content = await asyncio.to_thread(path.read_bytes)
            return web.Response(body=content, headers={"Content-Type": _IMAGES[kind]})
        text = await asyncio.to_thread(self._rendered, posixpath.normpath(name))
        return web.Response(text=text, content_type="text/html")

    def render(self, name: str) -> str:
        tokens = self._markdown.parse(self.files[name].read_text(encoding="utf-8"))
        title = ""
        for heading, inline in pairwise(tokens):
            if heading.type == "heading_open":
                title = title or "".join(child.content for child in inline.children or [])
                heading.attrSet("id", anchor_of(inline.content))
        _mark_reasons(tokens)
        for token in tokens:
            token.children = self._with_links(name, token.children or [])
        body = self._markdown.renderer.render(tokens, self._markdown.options, {})
        body = body.replace("<table>", '<div class="wide" tabindex="0"><table>').replace(
            "</table>", "</table></div>"
        )
        body = body.replace("<pre>", '<pre tabindex="0">')  # both scroll
        return _PAGE.format(title=html.escape(title), body=body)

    def _with_links(self, name: str, children: list[Token]) -> list[Token]:
        """A link to a file that is not of the manual becomes plain text; one elsewhere opens apart."""
        kept, is_dropped = [], False
        for token in children:
            if token.type == "link_open":
                target = str(token.attrGet("href") or "")
                is_dropped = not (self._has(name, target) or re.match("https?://", target))
                if re.match("https?://", target):
                    token.attrSet("rel", "noreferrer")
                if is_dropped:
                    continue
            if token.type == "link_close" and is_dropped:
                is_dropped = False
                continue
            kept.append(token)
        return kept

    def _has(self, name: str, target: str) -> bool:
        path = target.partition("#")[0]
        place = posixpath.normpath(posixpath.join(posixpath.dirname(name), path)) if path else name
        return place in self.files or posixpath.join(place, INDEX) in self.files


async def _to_contents(request: web.Request) -> web.Response:
    raise web.HTTPFound("/help/")


async def _to_reason(request: web.Request) -> web.Response:
    """A page that is open may have a reason of another version of the service."""
    raise web.HTTPFound(f"/help/{REASON_PLACES.get(request.match_info['reason'], 'operations.md#health')}")


def _mark_reasons(tokens: list[Token]) -> None:
    """Rows of tables of reason ids get these as their ids."""
    is_of_reasons = False
    for row, _, cell in zip(tokens, tokens[1:], tokens[2:], strict=False):
        if row.type == "tr_open":
            is_of_reasons = cell.content == "reason id" or (is_of_reasons and cell.content.startswith("`"))
            if is_of_reasons and cell.content != "reason id":
                row.attrSet("id", cell.content.strip("`"))


def anchor_of(heading: str) -> str:
    """Anchor of a heading as GitHub makes it: lower case, punctuation dropped, blanks to hyphens."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
