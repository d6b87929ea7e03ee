"""The page: its sections and their texts."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from drivers.counted import counted
from service import web
from service.mapstore.picture import WHITE_FREE
from service.offline.report.charts import clock, timeline
from service.offline.report.content import Content, path_length_m, read_content
from service.offline.report.map_figure import map_figure
from service.offline.report.markup import Markup, joined, tag
from service.offline.writing import complete_files, refuse_unwritable_file

REPORT_FILE = "report.html"
OLDEST_NS = 946_684_800_000_000_000  # the year 2000: stamps before it have no date
MAX_ROWS = 12  # of the loops with the largest errors
STYLE = Path(__file__).with_name("style.css")
# The page fetches and runs nothing.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def write_report(result: Path, out: Path) -> None:
    """The result in a folder as one HTML page.

    Raises InputError where the folder is none of a replay or a file of it is damaged or not there,
    StorageError.
    """
    content = read_content(result)
    refuse_unwritable_file(out)
    page = page_of(content, links=out.resolve().parent == result.resolve())
    with complete_files(out) as path:
        path.write_text(page, encoding="utf-8", errors="backslashreplace")


def page_of(content: Content, links: bool) -> str:
    """links: the page lies beside the other files of the result."""
    name = _name(content)
    parts = (
        _header(content, name),
        _warnings(content),
        _figures(content),
        section("Map", map_figure(content), _map_note(content)),
        section("Over time", timeline(content), _time_note()),
        section("Why scans were not ok", _reasons(content)),
        section("Loops", *_loops(content)),
        section("Sensors", _sensors(content)),
        section("Settings", _settings(content)),
        _footer(content, links),
    )
    return html_page(f"{name}: report of a drive", parts)


def html_page(title: str, parts: object) -> str:
    """A page that fetches and runs nothing, in the style of the reports."""
    head = tag(
        "head",
        Markup('<meta charset="utf-8">'),
        Markup(f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'),
        Markup('<meta name="viewport" content="width=device-width, initial-scale=1">'),
        tag("title", title),
        tag("style", Markup(_style())),
    )
    return f'<!DOCTYPE html>\n<html lang="en">{head}{tag("body", tag("main", parts))}</html>\n'


def _style() -> str:
    """With the colours of the operator's page, which knows light and dark ones."""
    colours = Path(web.__file__).with_name("static") / "page.css"
    light, dark = re.findall(
        r"^:root[^{]*\{(.*?)\n\}", colours.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    return (
        f":root{{{light}}}\n@media screen and (prefers-color-scheme: dark){{:root{{{dark}}}}}\n"
        f"{STYLE.read_text(encoding='utf-8')}"
    )


def _name(content: Content) -> str:
    recordings = content.summary.recording
    first = recordings[0] if recordings else content.folder.resolve().name
    return f"{first} and {len(recordings) - 1} more" if len(recordings) > 1 else first


def _header(content: Content, name: str) -> Markup:
    summary = content.summary
    facts = [f"{clock(content.duration_s)} {'h' if content.duration_s >= 3600 else 'min'} of driving"]
    if content.begin_ns >= OLDEST_NS:
        facts.insert(0, f"{datetime.fromtimestamp(content.begin_ns / 1e9, UTC):%d %B %Y, %H:%M:%S} UTC")
    facts += [f"profile {summary.profile}", f"corridor {summary.corridor}"]
    if content.edit is not None:
        facts.append(f"map as edited: {content.edit}")
    return tag(
        "header", tag("h1", name), tag("p", " · ".join(facts)), tag("p", _verdict(content), class_="verdict")
    )


def _verdict(content: Content) -> list[object]:
    """In one sentence: how much of the drive can be relied on."""
    scans, states = content.summary.scans, content.summary.state
    if scans == states.get("ok"):
        return [tag("span", "ok", class_="chip ok"), " All ", counted(scans, "scan"), " were placed well."]
    chips: list[object] = []
    for state in ("degraded", "lost"):
        if count := states.get(state, 0):
            chips += [tag("span", f"{state} {_percent(count / scans)}", class_=f"chip {state}"), " "]
    ok = states.get("ok", 0) / scans
    return [*chips, f"{_percent(ok)} of {counted(scans, 'scan')} were placed well."]


def _percent(share: float) -> str:
    """Never 100 % of what is not all, nor 0 % of what is something."""
    if 0.0 < share < 1.0:
        share = min(max(share, 0.001), 0.999)
    return f"{100 * share:.1f} %" if 0.0 < share < 1.0 else f"{100 * share:.0f} %"


def _warnings(content: Content) -> Markup:
    warnings = content.summary.warnings
    if not warnings:
        return tag("section", tag("p", "No warnings."), class_="warnings none")
    head = tag("h2", counted(len(warnings), "warning"))
    return tag("section", head, _list(warnings), class_="warnings")


def _figures(content: Content) -> Markup:
    summary, trajectory, states = content.summary, content.trajectory, content.states
    figures: list[tuple[str, str, str]] = []
    if trajectory is not None:
        figures.append(("Path", f"{path_length_m(trajectory.pose):,.1f} m".replace(",", " "), ""))
    free = sum(int((band == WHITE_FREE).sum()) for band in content.picture.bands())
    area_m2 = free * content.picture.cell_m**2
    figures.append(("Free area mapped", f"{area_m2:,.0f} m²".replace(",", " "), ""))
    worse = states.sigma[:, :2].max(axis=1)
    p50, p95 = np.percentile(worse, (50, 95), method="nearest")
    figures.append(("Sigma of the position", _length(p50), f"95 % below {_length(p95)}"))
    heading = np.percentile(states.sigma[:, 2], (50, 95), method="nearest")
    figures.append(("Sigma of the heading", _angle(heading[0]), f"95 % below {_angle(heading[1])}"))
    lost = f"{counted(summary.scans_dropped, 'more', 'more')} dropped" if summary.scans_dropped else ""
    figures.append(("Scans", f"{summary.scans:,}".replace(",", " "), lost))
    off = [loop.off_mm for loop in content.loops or () if not loop.why_not]
    note = f"median error {_length(float(np.median(off)) / 1e3)}" if off else ""
    figures.append(("Loops closed", str(summary.loop_closures), note))
    cards = [
        tag("div", tag("dt", name), tag("dd", value), tag("dd", note, class_="more") if note else None)
        for name, value, note in figures
    ]
    return tag("dl", cards, class_="figures")


def _length(metres: float) -> str:
    if not np.isfinite(metres):
        return "not known"
    if metres < 0.00995:
        return f"{1e3 * metres:.1f} mm"
    return f"{1e3 * metres:.0f} mm" if metres < 0.0995 else f"{metres:.2f} m"


def _angle(degrees: float) -> str:
    return f"{degrees:.2f}°" if np.isfinite(degrees) else "not known"


def _map_note(content: Content) -> Markup:
    words = ["Grid and coordinates in metres of the map."]
    if content.geo is None:
        words.append("The arrow is the y axis of the map, whose north is not known.")
    words.append(
        "Sigma is that of the pose in the map as it was published, before the last optimisation, in the "
        "worse of its two directions."
    )
    return tag("p", " ".join(words), class_="note")


def _time_note() -> Markup:
    return tag(
        "p",
        "Time since the first scan. Each point is the worst of its stretch of time. Red in the row of a "
        "sensor is a gap of more than three of its periods.",
        class_="note",
    )


def _reasons(content: Content) -> Markup | None:
    """Counted by id of the reason."""
    words = {
        (state, reason.id): reason.reason
        for state, reasons in content.summary.state_reasons.items()
        for reason in reversed(reasons)
    }
    rows: list[Sequence[object]] = []
    states = content.states
    pairs = list(zip(states.state, states.reason_id, strict=True))
    first = {pair: k for k, pair in reversed(list(enumerate(pairs)))}
    for (state, reason_id), count in Counter(pairs).most_common():
        if state != "ok":
            at_s = (int(states.stamp_ns[first[state, reason_id]]) - content.begin_ns) / 1e9
            chip = tag("span", state, class_=f"chip {state}")
            rows.append((chip, reason_id, count, clock(at_s), words.get((state, reason_id), "")))
    return table(("state", "reason", "scans", "first at", "in words, the first of them"), rows)


def _loops(content: Content) -> list[Markup | None]:
    if content.loops is None:
        return [tag("p", "No graph is stored: the profile has none, or the drive was localised only.")]
    accepted = [loop for loop in content.loops if not loop.why_not]
    refused = Counter(loop.why_not for loop in content.loops if loop.why_not)
    if not content.loops:
        return [tag("p", "No place was seen twice, so that no loop was measured: the path drifts freely.")]
    parts: list[Markup | None] = []
    if accepted:
        off = np.array([(loop.off_mm, loop.off_deg) for loop in accepted])
        p50, p95 = np.percentile(off, (50, 95), axis=0)
        parts.append(
            tag(
                "p",
                f"{counted(len(accepted), 'loop holds', 'loops hold')} the map together. The finished graph "
                f"leaves them off by {_length(p50[0] / 1e3)} and {_angle(p50[1])} (median), 95 % by at most "
                f"{_length(p95[0] / 1e3)} and {_angle(p95[1])}, the worst by "
                f"{_length(off[:, 0].max() / 1e3)}.",
            )
        )
    if refused:
        words = [f"{count}: {why}" for why, count in refused.most_common()]
        parts += [
            tag("p", f"{counted(refused.total(), 'loop was', 'loops were')} measured and refused:"),
            _list(words),
        ]
    worst = sorted(content.loops, key=lambda loop: (bool(loop.why_not), -loop.off_mm))[:MAX_ROWS]
    rows = [
        (
            clock((loop.back_ns - content.begin_ns) / 1e9) if loop.back_ns >= content.begin_ns else "earlier",
            f"{loop.x_m:.1f}",
            f"{loop.y_m:.1f}",
            f"{loop.off_mm:.1f}",
            f"{loop.off_deg:.2f}",
            loop.why_not or "accepted",
        )
        for loop in worst
    ]
    heads = ("back at", "x m", "y m", "off mm", "off °", "result")
    summary = tag("summary", f"The {counted(len(rows), 'loop')} with the largest errors, accepted ones first")
    parts.append(tag("details", summary, table(heads, rows)))
    return parts


def _sensors(content: Content) -> Markup | None:
    rows = []
    mountings = content.summary.mountings
    for name, frames in content.summary.sensors.items():
        sensor, _, kind = name.rpartition("/")
        mounting = mountings.get(sensor) if kind in ("scan", "fix") else None
        longest = max(frames.longest_gaps, key=lambda gap: gap[1], default=None)
        rows.append(
            (
                sensor,
                kind,
                frames.frames,
                "" if frames.rate_hz is None else f"{frames.rate_hz:.4g}",
                frames.gaps,
                "" if longest is None else f"{longest[1]:.2f} s at {clock(longest[0])}",
                "" if mounting is None else f"{mounting.x_m:g} m, {mounting.y_m:g} m, {mounting.yaw_deg:g}°",
            )
        )
    heads = ("sensor", "kind", "frames", "rate Hz", "gaps", "longest gap", "mounting x, y, yaw")
    return table(heads, rows)


def _settings(content: Content) -> Markup:
    mapping = content.summary.mapping
    settings = mapping.get("settings")
    plain = {name: value for name, value in mapping.items() if name != "settings"}
    groups = {"mapping": plain, **(settings if isinstance(settings, Mapping) else {})}
    tables = [
        tag("div", tag("h3", name), table((), _flat(values))) for name, values in groups.items() if values
    ]
    return tag("details", tag("summary", "What mapped this drive"), tag("div", tables, class_="settings"))


def _flat(values: Any, prefix: str = "") -> list[Sequence[object]]:
    if not isinstance(values, Mapping):
        return [(prefix, "none" if values in (None, [], {}) else values)]
    if not values:
        return [(prefix, "none")]
    return [
        row for key, value in values.items() for row in _flat(value, f"{prefix}.{key}" if prefix else key)
    ]


def section(title: str, *parts: object) -> Markup | None:
    """None where its first part is."""
    if not parts or parts[0] is None:
        return None
    return tag("section", tag("h2", title), parts)


def _list(lines: Sequence[str]) -> Markup:
    return tag("ul", [tag("li", line) for line in lines])


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> Markup | None:
    """None without a row; the heads may be left out."""
    if not rows:
        return None
    head = tag("thead", tag("tr", [tag("th", text) for text in heads])) if heads else None
    body = [tag("tr", [tag("td", cell, class_=_kind(cell)) for cell in row]) for row in rows]
    return tag("div", tag("table", head, tag("tbody", body)), class_="wide")


def _kind(cell: object) -> str | None:
    return "number" if isinstance(cell, int | float) and not isinstance(cell, bool) else None


def _footer(content: Content, links: bool) -> Markup:
    parts: list[object] = [
        "Made by corridor report of the folder ",
        tag("code", content.folder.resolve().name),
        ".",
    ]
    if links:
        names = sorted(
            path.name
            for path in content.folder.iterdir()
            if path.is_file() and path.name != REPORT_FILE and not path.name.startswith(".")
        )
        parts += [" Beside this page: ", joined([[tag("a", name, href=name), " "] for name in names])]
    return tag("footer", tag("p", parts))
