"""The file of faults: its content, and refusals."""

from pathlib import Path

import pytest

from service.errors import ConfigError
from simulators.fault_file import KINDS, parse_faults, read_faults
from simulators.irobot_create import FakeCreate
from simulators.sick_lms100 import FakeLms100
from tests.drivers.irobot_bench import STANDING
from tests.drivers.lms100 import Room
from tests.silent_device import SilentDevice


class Switchboard:
    """Serves many clients."""

    def new_client(self) -> FakeLms100:
        return FakeLms100(Room())


DEVICES = {
    "front": FakeLms100(Room()),
    "base": FakeCreate(STANDING),
    "hub": Switchboard(),
    "plain": SilentDevice(),
}


def parse(text: str):
    return parse_faults(text, "faults.yaml", DEVICES)


def refusals(text: str) -> list[str]:
    with pytest.raises(ConfigError) as refused:
        parse(text)
    return refused.value.faults


def one(line: str) -> str:
    """The only refusal of a file with this one fault in it; line 2, text from column 5 on."""
    [refusal] = refusals(f"faults:\n  - {line}\n")
    return refusal


def test_faults_are_read_in_their_order_with_their_defaults():
    cut, flips, slow = parse(
        "faults:\n"
        "  - {device: front, kind: cut, at_s: 10}\n"
        "  - {device: base, kind: bit_flips, at_s: 5, for_s: 3, every_s: 20, count: 4, rate: 0.0005}\n"
        "  - {device: front, kind: slow_start, for_s: 6}\n"
    )
    assert cut.model_dump() == {
        "device": "front", "kind": "cut", "at_s": 10.0, "for_s": 2.0,
        "every_s": None, "jitter_s": None, "count": None,
    }  # fmt: skip
    assert (flips.rate, flips.times, flips.lasts_s, flips.jitter_up_to_s) == (0.0005, 4, 3.0, 5.0)
    assert (slow.kind, slow.at_s, slow.for_s) == ("slow_start", 0.0, 6.0)


@pytest.mark.parametrize(
    ("line", "where", "diagnostic"),
    [
        ("{device: frnt, kind: cut}", "2:6: faults.0.device", "no device 'frnt'; did you mean \"front\"?"),
        ("{device: x, kind: cut}", "2:6: faults.0.device", "no device 'x'; known here: front, base, hub"),
        ("{device: front, kind: toast}", "2:21: faults.0.kind", "no kind 'toast'; known here: cut, silence"),
        ("{device: front}", "2:5: faults.0.kind", "missing; known here: cut"),
        ("{kind: cut}", "2:5: faults.0.device", "missing; known here: front"),
        ("{device: front, kind: silence}", "2:5: faults.0.for_s", "missing, and there is no sensible"),
        ("{device: front, kind: cut, for: 2}", "2:32: faults.0.for", 'this setting is "for_s", in seconds'),
        ("{device: front, kind: cut, for_s: 1s}", "2:32: faults.0.for_s", 'a valid number (got "1s")'),
        ("{device: front, kind: cut, at_s: -1}", "2:32: faults.0.at_s", "or equal to 0 (got -1)"),
        ("{device: front, kind: cut, count: 3}", "2:5: faults.0", "add every_s, or take them out"),
        (
            "{device: front, kind: cut, for_s: 4, every_s: 4.5}",
            "2:5: faults.0",
            "4 s with up to 1.125 s of jitter do not fit into every_s 4.5",
        ),
        ("{device: front, kind: clock_jump, by_s: 1, for_s: 2}", "2:48: faults.0.for_s", "unknown key"),
        ("{device: base, kind: clock_jump, by_s: 1}", "2:20: faults.0.kind", "base sends no clock"),
        ("{device: plain, kind: restart}", "2:21: faults.0.kind", "plain cannot be restarted; take cut"),
        ("{device: hub, kind: cut}", "2:6: faults.0.device", "hub serves several clients"),
        ("{device: front, kind: drop, for_s: 012}", "2:40: faults.0.for_s", "YAML takes 012 for octal"),
        ("cut", "2:5: faults.0", "a fault is a mapping"),
    ],
)  # fmt: skip
def test_a_fault_that_cannot_be_is_refused_with_place_and_advice(line: str, where: str, diagnostic: str):
    refusal = one(line)
    assert refusal.startswith(f"faults.yaml:{where}: ")
    assert diagnostic in refusal


@pytest.mark.parametrize("text", ["", "- {device: front, kind: cut}", "faults: 3", "fault: []"])
def test_a_file_without_a_list_of_faults_is_refused(text: str):
    assert any("one key, faults, with a list below it" in refusal for refusal in refusals(text))


def test_all_that_is_wrong_is_reported_at_once():
    found = refusals("faults:\n  - {device: x, kind: cut}\n  - {device: front, kind: y}\nmore: 1\n")
    assert [refusal.split(":")[1] for refusal in found] == ["2", "3", "4"]


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: cannot be read: No such file or directory$"):
        read_faults(tmp_path / "nowhere.yaml", DEVICES)


def test_the_documented_file_can_be_read():
    page = Path(__file__).parents[2] / "docs" / "simulation.md"
    text = page.read_text(encoding="utf-8")
    example = text.split("```yaml\n")[1].split("```")[0]
    assert [fault.kind for fault in parse(example)] == ["cut", "bit_flips"]
    assert all(f"`{kind}`" in text for kind in KINDS)
