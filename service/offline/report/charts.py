"""Charts over the time of a drive: one time axis for all, rendered in a width that the page decides.

Lines are SVG that is stretched; text is HTML beside it, so that it keeps its size.
"""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from service.geometry.poses import Floats
from service.offline.report.content import Content, Loop, SensorFrames
from service.offline.report.markup import Markup, joined, tag
from service.outputs import STATES

COLUMNS = 800  # of a chart: a point each, the worst of its stretch of time
HEIGHT = 100.0  # of a chart in its own units
MAX_TICKS = 7
DAY_S = 86_400
TICKS_S = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, DAY_S)
Ints = npt.NDArray[np.int64]


class TimeAxis:
    """From the first to the last scan of a drive."""

    def __init__(self, content: Content) -> None:
        self._begin_ns = content.begin_ns
        self.duration_s = max(content.duration_s, 1e-3)

    def share(self, seconds: float) -> float:
        """Share of the width, %, at seconds since the begin."""
        return 100.0 * min(max(seconds / self.duration_s, 0.0), 1.0)

    def seconds(self, stamp_ns: int) -> float:
        return (stamp_ns - self._begin_ns) / 1e9

    def columns(self, stamp_ns: Ints) -> Ints:
        """(N,) of each stamp."""
        share = np.clip((stamp_ns - self._begin_ns) / 1e9 / self.duration_s, 0.0, 1.0)
        return np.minimum((share * COLUMNS).astype(np.int64), COLUMNS - 1)

    def ticks(self) -> Markup:
        words = [tag("span", clock(s), style=f"left:{self.share(s):.3f}%") for s in self._at_s()]
        return tag("div", words, class_="ticks")

    def grid(self) -> str:
        return "".join(f"M{self.share(s) / 100 * COLUMNS:.2f} 0v{HEIGHT:g}" for s in self._at_s())

    def _at_s(self) -> list[int]:
        days = math.ceil(self.duration_s / MAX_TICKS / DAY_S)
        step_s = next((s for s in TICKS_S if self.duration_s / s <= MAX_TICKS), days * DAY_S)
        return list(range(0, math.floor(self.duration_s) + 1, step_s))


def clock(seconds: float) -> str:
    """0:05, 12:30, 1:02:03."""
    whole = round(seconds)
    hours, minutes = whole // 3600, whole // 60 % 60
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"


def timeline(content: Content) -> Markup:
    axis = TimeAxis(content)
    states = content.states
    column = axis.columns(states.stamp_ns)
    along, across, heading = states.sigma.T
    metres = LogScale.of(np.concatenate((along, across)), 0.001, "m")
    degrees = LogScale.of(heading, 0.01, "deg")
    share = _ShareScale()
    worst = {"inlier": states.inlier_ratio}
    rows = [
        row("state", _state_strip(states.state, column), "strip"),
        row(
            "sigma of the position",
            [_lines(axis, metres, column, {"along": along, "across": across}), metres.words()],
            legend=(("along", "ahead"), ("across", "to the side")),
        ),
        row("sigma of the heading", [_lines(axis, degrees, column, {"heading": heading}), degrees.words()]),
        row("returns on the map", [_lines(axis, share, column, worst, np.minimum), share.words()]),
    ]
    if content.loops:
        rows.append(_loops_row(axis, content.loops))
    rows += [_sensor_row(axis, name, frames) for name, frames in content.summary.sensors.items()]
    return tag("div", rows, tag("div", axis.ticks(), class_="row axis"), class_="timeline")


class LogScale:
    """Decades, from one below the smallest value to one above the largest."""

    def __init__(self, first: int, last: int, unit: str) -> None:
        self._first, self._last, self._unit = first, last, unit

    @classmethod
    def of(cls, values: Floats, least: float, unit: str) -> "LogScale":
        known = values[np.isfinite(values) & (values > 0.0)]
        low, high = (float(known.min()), float(known.max())) if len(known) else (1.0, 1.0)
        first = math.floor(math.log10(max(low, least)))
        return cls(first, max(math.ceil(math.log10(max(high, least))), first + 1), unit)

    def y(self, values: Floats) -> Floats:
        """From the top; unknown values are at the top."""
        with np.errstate(divide="ignore"):
            share = (np.log10(values) - self._first) / (self._last - self._first)
        return HEIGHT * (1.0 - np.clip(np.nan_to_num(share, nan=1.0), 0.0, 1.0))

    def grid(self) -> str:
        decades = range(self._first + 1, self._last)
        return "".join(f"M0 {self.y(np.array([10.0**k]))[0]:.2f}h{COLUMNS}" for k in decades)

    def words(self) -> Markup:
        decades = range(self._first, self._last + 1)
        return joined(
            [
                tag("span", self._word(k), class_="scale", style=f"top:{self.y(np.array([10.0**k]))[0]:.2f}%")
                for k in decades
            ]
        )

    def _word(self, decade: int) -> str:
        if self._unit != "m":
            return f"{10.0**decade:g} {self._unit}"
        unit, power = ("mm", 3) if decade < -2 else ("cm", 2) if decade < 0 else ("m", 0)
        return f"{10.0 ** (decade + power):g} {unit}"


class _ShareScale:
    """0 to 1, as per cent."""

    def y(self, values: Floats) -> Floats:
        return HEIGHT * (1.0 - np.clip(values, 0.0, 1.0))

    def grid(self) -> str:
        return f"M0 {HEIGHT / 2:g}h{COLUMNS}"

    def words(self) -> Markup:
        return joined(
            [tag("span", f"{share} %", class_="scale", style=f"top:{100 - share}%") for share in (0, 50, 100)]
        )


def row(
    name: str, content: object, kind: str = "", legend: Sequence[tuple[str, str]] = (), note: str = ""
) -> Markup:
    keys = [tag("span", tag("i", class_=f"key {key}"), words) for key, words in legend]
    head = tag("div", tag("b", name), keys, tag("small", note) if note else None, class_="head")
    return tag("div", head, tag("div", content, class_="plot"), class_=f"row {kind}".rstrip())


def canvas(*elements: object) -> Markup:
    return tag(
        "svg",
        elements,
        view_box=f"0 0 {COLUMNS} {HEIGHT:g}",
        preserve_aspect_ratio="none",
        aria_hidden="true",
    )


def _state_strip(states: Sequence[str], column: Ints) -> Markup:
    """A box for each stretch of one state, the worst of each column."""
    rank: dict[str, int] = {state: k for k, state in enumerate(STATES)}
    of_scans = np.array([rank[state] for state in states])
    worst = np.full(COLUMNS, -1)
    np.maximum.at(worst, column, of_scans)
    _fill(worst, column)
    edges = [0, *(np.flatnonzero(np.diff(worst)) + 1).tolist(), COLUMNS]
    boxes = []
    for begin, end in pairwise(edges):
        if worst[begin] >= 0:
            state = STATES[worst[begin]]
            title = tag("title", state)
            boxes.append(
                tag("rect", title, class_=state, x=begin, y=0, width=end - begin, height=f"{HEIGHT:g}")
            )
    return canvas(boxes)


def _fill(values: Ints, column: Ints) -> None:
    """Columns without a scan between two that follow one another closely are as the one before."""
    usual = float(np.median(np.diff(column))) if len(column) > 1 else 0.0
    most = max(3.0 * usual, 2.0)
    for before, after in pairwise(column.tolist()):
        if 1 < after - before <= most:
            values[before + 1 : after] = values[before]


def _lines(
    axis: TimeAxis,
    scale: LogScale | _ShareScale,
    column: Ints,
    lines: dict[str, Floats],
    worst: Callable[..., Floats] = np.maximum,
) -> Markup:
    """A line each, broken where no scan came for long."""
    begins = np.flatnonzero(np.diff(column, prepend=-1))
    at = column[begins]
    most = max(3.0 * float(np.median(np.diff(at))), 4.0) if len(at) > 1 else 1.0
    breaks = np.flatnonzero(np.diff(at) > most) + 1
    elements = [tag("path", class_="grid", d=axis.grid() + scale.grid())]
    for name, values in lines.items():
        y = scale.y(worst.reduceat(values, begins))  # type: ignore[attr-defined]  # of a ufunc
        for stretch in np.split(np.column_stack((at + 0.5, y)), breaks):
            if len(stretch) == 1:
                stretch = np.vstack((stretch, stretch + np.array([1.0, 0.0])))
            points = " ".join(f"{x:.1f},{of:.2f}" for x, of in stretch.tolist())
            elements.append(tag("polyline", class_=f"line {name}", points=points))
    return canvas(elements)


def _loops_row(axis: TimeAxis, loops: Sequence[Loop]) -> Markup:
    """A dot each at the moment when the place was seen again: how far the finished graph leaves it off."""
    shown = [loop for loop in loops if 0.0 <= axis.seconds(loop.back_ns) <= axis.duration_s]
    scale = LogScale.of(np.array([loop.off_mm / 1e3 for loop in shown]), 0.001, "m")
    dots = []
    for loop in shown:
        top = scale.y(np.array([max(loop.off_mm / 1e3, 1e-9)]))[0]
        at_s = axis.seconds(loop.back_ns)
        what = f"{clock(at_s)}, off by {loop.off_mm:.0f} mm and {loop.off_deg:.2f} deg"
        dots.append(
            tag(
                "i",
                class_="dot refused" if loop.why_not else "dot",
                style=f"left:{axis.share(at_s):.3f}%;top:{top:.2f}%",
                title=f"{what}; refused: {loop.why_not}" if loop.why_not else what,
            )
        )
    grid = canvas(tag("path", class_="grid", d=axis.grid() + scale.grid()))
    return row(
        "error of the loops",
        [grid, scale.words(), dots],
        legend=(("accepted", "accepted"), ("refused", "refused")),
    )


def _sensor_row(axis: TimeAxis, name: str, frames: SensorFrames) -> Markup:
    gaps = [
        tag(
            "rect",
            tag("title", f"gap of {length_s:.2f} s at {clock(at_s)}"),
            class_="gap",
            x=f"{axis.share(at_s) / 100 * COLUMNS:.2f}",
            y=0,
            width=f"{max((axis.share(at_s + length_s) - axis.share(at_s)) / 100 * COLUMNS, 1.5):.2f}",
            height=f"{HEIGHT:g}",
        )
        for at_s, length_s in frames.longest_gaps
    ]
    rate = "" if frames.rate_hz is None else f"{frames.rate_hz:.4g} Hz"
    strip = canvas(tag("rect", class_="frames", x=0, y=0, width=COLUMNS, height=f"{HEIGHT:g}"), gaps)
    return row(name, strip, "strip", note=rate)
