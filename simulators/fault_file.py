"""The file of faults a run is given: YAML to a list of Fault, or every mistake in it with its place.

    faults:
      - {device: front, kind: cut, at_s: 10, for_s: 2}
      - {device: base, kind: bit_flips, at_s: 5, for_s: 3, every_s: 20, rate: 0.0005}

The effects of the kinds: simulators/faults.py.
"""

import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from drivers.section import Section
from service.located_model import add_fault, raise_faults, read_file, validated
from service.located_yaml import Document, load
from service.located_yaml import Path as KeyPath
from service.suggestion import suggest
from simulators.device import FakeDevice, HasClock, ManyClients, Restartable

DAY_S = 86_400.0
JITTER_SHARE = 0.25  # of the period, where nothing else is configured


class Fault(Section):
    """One line of the file. Times are seconds since the devices were ready."""

    device: str
    kind: str
    at_s: float = Field(default=0.0, ge=0.0, le=DAY_S)


class RepeatedFault(Fault):
    """Comes at at_s and, with every_s, again and again: the k-th time up to jitter_s later than
    at_s + k * every_s, sampled from the seed.
    """

    every_s: float | None = Field(default=None, ge=0.1, le=DAY_S)
    jitter_s: float | None = Field(default=None, ge=0.0, le=DAY_S)  # None: a quarter of every_s
    count: int | None = Field(default=None, ge=1)  # None: once, or with every_s to the end of the run

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.every_s is None:
            if self.count not in (None, 1) or self.jitter_s is not None:
                raise ValueError("count and jitter_s say how to repeat; add every_s, or take them out")
        elif self.lasts_s + self.jitter_up_to_s > self.every_s:
            raise ValueError(
                f"{self.lasts_s:g} s with up to {self.jitter_up_to_s:g} s of jitter do not fit into every_s "
                f"{self.every_s:g}; the next would begin before the last has ended"
            )
        return self

    @property
    def jitter_up_to_s(self) -> float:
        if self.every_s is None:
            return 0.0
        return JITTER_SHARE * self.every_s if self.jitter_s is None else self.jitter_s

    @property
    def times(self) -> int | None:
        """How often it comes; None: without end."""
        return 1 if self.every_s is None else self.count

    @property
    def lasts_s(self) -> float:
        """How long it lasts each time."""
        return 0.0


class LastingFault(RepeatedFault):
    for_s: float = Field(gt=0.0, le=DAY_S)

    @property
    def lasts_s(self) -> float:
        return self.for_s


class Cut(LastingFault):
    kind: Literal["cut"]
    for_s: float = Field(default=2.0, gt=0.0, le=DAY_S)


class Silence(LastingFault):
    kind: Literal["silence"]


class Restart(LastingFault):
    kind: Literal["restart"]
    for_s: float = Field(default=1.0, gt=0.0, le=DAY_S)  # without power
    link_drops: bool = True  # False: a serial adapter that the host feeds stays


class SlowStart(Fault):
    kind: Literal["slow_start"]
    for_s: float = Field(gt=0.0, le=DAY_S)


class ClockJump(RepeatedFault):
    kind: Literal["clock_jump"]
    by_s: float = Field(ge=-DAY_S, le=DAY_S)


class MessageFault(LastingFault):
    """Hits each message with chance `share` while it lasts."""

    share: float = Field(default=1.0, gt=0.0, le=1.0)


class Garbage(MessageFault):
    kind: Literal["garbage"]
    up_to_bytes: int = Field(default=64, ge=1, le=65_536)


class BitFlips(LastingFault):
    kind: Literal["bit_flips"]
    rate: float = Field(default=1e-3, gt=0.0, le=0.5)  # of the bits


class PlainMessageFault(MessageFault):
    kind: Literal["half_messages", "wrong_checksum", "duplicate", "drop"]


class Delay(LastingFault):
    kind: Literal["delay"]
    up_to_ms: float = Field(gt=0.0, le=60_000.0)


class Burst(LastingFault):
    kind: Literal["burst"]
    hold_ms: float = Field(gt=0.0, le=60_000.0)


KINDS: dict[str, type[Fault]] = {
    kind: model
    for model in (
        *(Cut, Silence, Restart, SlowStart, ClockJump, Garbage, BitFlips),
        *(PlainMessageFault, Delay, Burst),
    )
    for kind in typing.get_args(model.model_fields["kind"].annotation)
}
Devices = Mapping[str, FakeDevice | ManyClients]


def read_faults(path: Path, devices: Devices) -> list[Fault]:
    """Read a file of faults for these devices, in its order. Raises ConfigError with every mistake."""
    return parse_faults(read_file(path), str(path), devices)


def parse_faults(text: str, file: str, devices: Devices) -> list[Fault]:
    """As read_faults, of a text; `file` names it in the mistakes."""
    document = load(text)
    faults = list(_Reader(document, devices).read())
    raise_faults(document, file)
    return faults


class _Reader:
    """Yields faults and collects mistakes of one document."""

    def __init__(self, document: Document, devices: Devices) -> None:
        self._document = document
        self._devices = devices

    def read(self) -> Iterator[Fault]:
        root = self._document.value
        if root is None and self._document.faults:
            return
        if not isinstance(root, dict) or not isinstance(root.get("faults"), list):
            self._refuse((), "a file of faults has one key, faults, with a list below it")
            return
        for key in root.keys() - {"faults"}:
            self._refuse((key,), "unknown key; the only one here is faults")
        for index, entry in enumerate(root["faults"]):
            fault = self._fault(entry, ("faults", index))
            if fault is not None:
                yield fault

    def _fault(self, entry: object, path: KeyPath) -> Fault | None:
        if not isinstance(entry, dict):
            self._refuse(path, "a fault is a mapping; write {device: front, kind: cut, at_s: 10}, say")
            return None
        device = self._choice(entry, path, "device", list(self._devices))
        kind = self._choice(entry, path, "kind", list(KINDS))
        if device is not None and kind is not None:
            self._refuse_impossible(device, kind, path)
        if kind is None:
            return None
        return validated(self._document, path, KINDS[kind], entry, own_keys=("device", "kind"))

    def _choice(self, entry: Mapping[str, Any], path: KeyPath, key: str, known: list[str]) -> str | None:
        value = entry.get(key)
        if value in known:
            return str(value)
        if key in entry:
            self._refuse((*path, key), f"there is no {key} {value!r}; {suggest(str(value), known)}")
        else:
            self._refuse((*path, key), f"missing; {suggest('', known)}")
        return None

    def _refuse_impossible(self, name: str, kind: str, path: KeyPath) -> None:
        device = self._devices[name]
        if isinstance(device, ManyClients):
            self._refuse(
                (*path, "device"), f"{name} serves several clients at a time; faults act on one link"
            )
        elif kind == "restart" and not isinstance(device, Restartable):
            self._refuse((*path, "kind"), f"{name} cannot be restarted; take cut")
        elif kind == "clock_jump" and not isinstance(device, HasClock):
            self._refuse((*path, "kind"), f"{name} sends no clock reading; a jump has no effect")

    def _refuse(self, path: KeyPath, message: str) -> None:
        add_fault(self._document, path, message)
