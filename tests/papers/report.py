"""Rows and sections of an experiment, and their page."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

TITLE = "## "
FOLDER = Path("build") / "papers"
COUNTS = ("cells", "corners", "fixes", "loops", "places", "scans")
DIGITS = {"MB": 0, "mm": 1, "%": 1, "ms": 2, "s": 2, "cm": 2, **dict.fromkeys(COUNTS, 0)}  # 3 of other units


@dataclass(frozen=True)
class Row:
    """One figure over all seeds. A bound is met by the median, or by the worst where `by_worst`."""

    what: str
    values: Sequence[float]  # one a seed
    unit: str  # of a count the things counted, of a ratio "times", of a share "of 1"
    case: str = ""  # the world, or what of the checklist, "A47 A5"
    at_most: float | None = None
    at_least: float | None = None
    by_worst: bool = False
    digits: int | None = None  # None: those of the unit
    cause: str = ""  # why the bound is missed, in a sentence: reported where it is

    def __post_init__(self) -> None:
        if not self.unit:
            raise ValueError(f"{self.what}: a figure without its unit")

    @property
    def median(self) -> float:
        return float(np.median(self.values))

    @property
    def worst(self) -> float:
        return float(np.min(self.values) if self.at_least is not None else np.max(self.values))

    @property
    def met(self) -> bool | None:
        """None where there is no bound."""
        value = self.worst if self.by_worst else self.median
        if self.at_most is not None:
            return value <= self.at_most
        return value >= self.at_least if self.at_least is not None else None


@dataclass(frozen=True)
class Section:
    """One experiment: what was done, its figures, further tables in Markdown, pictures in FOLDER."""

    title: str
    text: str
    rows: Sequence[Row] = ()
    tables: Sequence[str] = ()
    pictures: Sequence[tuple[str, str]] = field(default=())  # file name and caption
    ran_on: str = ""  # "" where it is every seed


def seeds_text(seeds: Sequence[int]) -> str:
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"


Scenario = Callable[[Sequence[int]], Section]  # from the seeds


def write_page(path: Path, head: str, made: Mapping[str, tuple[Section, str]], order: Sequence[str]) -> None:
    """Replace the sections of the scenarios that were made, each with what it ran on; the others stay, and
    those that no scenario wrote stay behind them. Raises OSError.
    """
    sections = _read(path.read_text(encoding="utf-8")) if path.exists() else {}
    for name, (section, ran) in made.items():
        lines = [f"{TITLE}{section.title}", "", f"Scenario `{name}`; {ran}.", "", *below_title(section)]
        sections[name] = "\n".join(line.rstrip() for line in lines).rstrip() + "\n"
    own = [name for name in sections if name.startswith(TITLE)]
    text = "\n".join([head, *(sections[name] for name in [*order, *own] if name in sections)])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _read(text: str) -> dict[str, str]:
    """The sections of a page as it is, by scenario; by title where no scenario wrote them."""
    sections = {}
    for part in re.split(rf"^(?={TITLE})", text, flags=re.MULTILINE)[1:]:
        named = re.search(r"^Scenario `(\w+)`", part, flags=re.MULTILINE)
        sections[named[1] if named else part.splitlines()[0]] = part.rstrip() + "\n"
    return sections


def below_title(section: Section) -> list[str]:
    """Text, tables and pictures, line by line."""
    lines = [section.text, ""]
    if section.rows:
        lines += [*_table(section.rows), ""]
    for table in section.tables:
        lines += [table.strip(), ""]
    for file, caption in section.pictures:
        lines += [f"![{caption}]({file})", "", f"*{caption}*", ""]
    return lines


def _table(rows: Sequence[Row]) -> list[str]:
    """Without the column of cases where no row names one."""
    cells = [("case", "figure", "median", "worst", "bound", "met"), *map(_cells, rows)]
    first = 0 if any(row.case for row in rows) else 1
    lines = [f"| {' | '.join(row[first:])} |" for row in cells]
    return [lines[0], "|" + "---|" * (6 - first), *lines[1:]]


def _cells(row: Row) -> tuple[str, ...]:
    bound = "" if row.at_most is None else f"≤ {row.at_most:g} {row.unit}"
    if row.at_least is not None:
        bound = f"≥ {row.at_least:g} {row.unit}"
    if bound and row.by_worst:
        bound += " every seed"
    met = {None: "", True: "yes", False: f"**no**: {row.cause}" if row.cause else "**no**"}[row.met]
    digits = DIGITS.get(row.unit, 3) if row.digits is None else row.digits
    median, worst = (f"{value:.{digits}f} {row.unit}" for value in (row.median, row.worst))
    return row.case, row.what, median, worst, bound, met
