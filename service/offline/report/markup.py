"""HTML and SVG whose texts cannot break out: whatever is no Markup is escaped."""

from html import escape


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def tag(name: str, *children: object, **attributes: object) -> Markup:
    """An element. None, among children or as an attribute, is left out; class_ is written class, view_box
    viewBox, stroke_width stroke-width.
    """
    written = "".join(
        f' {_written(key)}="{escape(str(value))}"' for key, value in attributes.items() if value is not None
    )
    return Markup(f"<{name}{written}>{joined(children)}</{name}>")


def joined(children: object) -> Markup:
    """One after the other; lists and tuples are walked through."""
    if children is None:
        return Markup("")
    if isinstance(children, Markup):
        return children
    if isinstance(children, list | tuple):
        return Markup("".join(map(joined, children)))
    return Markup(escape(str(children)))


def _written(key: str) -> str:
    return {"view_box": "viewBox", "preserve_aspect_ratio": "preserveAspectRatio"}.get(
        key, key.rstrip("_").replace("_", "-")
    )
