"""What the doctor found, and how it is reported."""

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from drivers.counted import counted

Severity = Literal["ok", "note", "fault"]

_LABELS: dict[Severity, str] = {"ok": "ok", "note": "note", "fault": "FAULT"}
_COLOURS: dict[Severity, str] = {"ok": "\x1b[32m", "note": "\x1b[33m", "fault": "\x1b[1;31m"}
_PLAIN = "\x1b[0m"
_LABEL_WIDTH = 7


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one test: ok, a note, or a fault with its remedy."""

    severity: Severity
    who: str  # a sensor's name, or the part of the machine: disk, clock, zenoh
    measured: str
    expected: str = ""  # "" where that is reported already
    remedy: str = ""  # "" where nothing has to be done
    values: Mapping[str, float | str] = field(default_factory=dict)  # for programs: rate_hz, identity.serial


def ok(who: str, measured: str, **values: float | str) -> Finding:
    return Finding("ok", who, measured, values=values)


def note(who: str, measured: str, remedy: str, expected: str = "") -> Finding:
    return Finding("note", who, measured, expected, remedy)


def fault(who: str, measured: str, expected: str, remedy: str) -> Finding:
    return Finding("fault", who, measured, expected, remedy)


@dataclass(frozen=True, slots=True)
class Report:
    """All findings of one run. `config` is the file's name, "" where none was given."""

    config: str
    findings: tuple[Finding, ...]

    @property
    def counts(self) -> dict[str, int]:
        found = Counter(finding.severity for finding in self.findings)
        return {severity: found[severity] for severity in _LABELS}

    @property
    def exit_code(self) -> int:
        """1 where there is a fault, else 0."""
        return int(self.counts["fault"] > 0)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "config": self.config,
            "ok": self.exit_code == 0,
            "counts": self.counts,
            "findings": [asdict(finding) for finding in self.findings],
        }

    def text(self, width: int = 110, colour: bool = False) -> str:
        """Aligned lines for people; `colour` only where a terminal reads them."""
        name_width = max((len(finding.who) for finding in self.findings), default=0) + 2
        lines = [line for finding in self.findings for line in _lines(finding, name_width, width, colour)]
        return "\n".join([*lines, "", self._summary()])

    def _summary(self) -> str:
        counts = self.counts
        worse = [counted(counts[what], what) for what in ("note", "fault") if counts[what]]
        head = "" if counts["fault"] else "nothing to mend: "
        return head + ", ".join([f"{counts['ok']} ok", *worse])


def _lines(finding: Finding, name_width: int, width: int, colour: bool) -> Sequence[str]:
    label = _LABELS[finding.severity].ljust(_LABEL_WIDTH)
    if colour:
        label = _COLOURS[finding.severity] + label + _PLAIN
    indent = " " * (_LABEL_WIDTH + name_width)
    room = max(width - len(indent), 40)
    paragraphs = [finding.measured]
    if finding.expected:
        paragraphs.append(f"expected: {finding.expected}")
    if finding.remedy:
        paragraphs.append(f"to do: {finding.remedy}")
    wrapped = [
        line
        for paragraph in paragraphs
        for line in textwrap.wrap(
            paragraph, room, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
        )
    ]
    return [label + finding.who.ljust(name_width) + wrapped[0], *(indent + line for line in wrapped[1:])]
