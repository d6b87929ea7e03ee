"""Configs as a slipping finger, a wrong paste or a broken disk leave them: faults with a place, no crash."""

import random
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from service.config import load_config, mapped_lasers, mounted_upside_down, mountings
from service.errors import ConfigError
from service.located_yaml import MAX_FILE_BYTES
from tests.soaked import in_soak

EXAMPLE = Path(__file__).parents[2] / "config" / "vehicle.yaml"
COUNT = 300
ODD_CHARACTERS = "\0 :,[]{}#&*!|>'\"%@`-?~\n\tx0é\ufeff\u2028"
FAULT = re.compile(r"[^\n]+\.yaml:\d+:\d+: [^\n]+")
ODD_VALUES = [
    *("9" * 5000, "-" + "9" * 25, "0x" + "f" * 9000, "0x_", "0x1_0", "0b_", "0o_7", "1" + "_0" * 99),
    *("1e999", "1e-999", "-.inf", ".nan", "1:99:99"),
    *(f"!!{kind} x" for kind in ("int", "float", "bool", "null")),
    *('"\\0"', '"a\\0b"', '"\\ud800"', '"\\U00110000"', '""', "''", "~", '"~/maps"', "/dev/null/x", '" "'),
    *("[" * 3000, "{a: " * 3000, "[" * 30 + "]" * 30, "[[]]", "{}", "[1, {a: b}]", "&a [*a]", "*b", "? [a]"),
    *("no", "on", "2026-01-01", "0777", "- - -", "%", "@", "`", "'", '"', "|", ">-", "!!python/name:os"),
    *("\t", "!!set {a}"),
    *('"192.168.0. 1"', '"tcp://192.168.0.1"', "192.168.0.1:2111", "{type: {}}", "[a]", "\x00", "é"),
]


def with_an_odd_value(text: str, dice: random.Random) -> str:
    """One value, or all of a line, is another."""
    lines = text.splitlines(keepends=True)
    k = dice.choice([k for k, line in enumerate(lines) if ":" in line.split("#")[0]])
    key, _, _ = lines[k].partition(":")
    lines[k] = f"{key}: {dice.choice(ODD_VALUES)}\n"
    return "".join(lines)


def with_an_odd_key(text: str, dice: random.Random) -> str:
    words = re.findall(r"\w+(?=:)", text)
    return text.replace(f"{dice.choice(words)}:", f"{dice.choice(ODD_VALUES)}:", 1)


def with_lines_moved(text: str, dice: random.Random) -> str:
    lines = text.splitlines(keepends=True)
    for _ in range(dice.randint(1, 4)):
        line = lines.pop(dice.randrange(len(lines)))
        if dice.random() < 0.7:
            lines.insert(dice.randrange(len(lines)), " " * dice.randint(0, 3) + line)
    return "".join(lines)


def with_characters_changed(text: str, dice: random.Random) -> str:
    characters = list(text)
    for _ in range(dice.randint(1, 8)):
        characters[dice.randrange(len(characters))] = dice.choice(ODD_CHARACTERS)
    return "".join(characters)


def cut_short(text: str, dice: random.Random) -> str:
    return text[: dice.randrange(len(text))] + text[dice.randrange(len(text)) :] * dice.randint(0, 1)


MUTATIONS: list[Callable[[str, random.Random], str]] = [
    with_an_odd_value,
    with_an_odd_value,  # finds most
    with_an_odd_key,
    with_lines_moved,
    with_characters_changed,
    cut_short,
]


@pytest.fixture(scope="module")
def example() -> str:
    """The complete example, with all that it leaves out, without its comments: they would take most hits."""
    whole = re.sub(r"(?m)^  # (?=rear:|lux:|imu:|  \w+: )", "  ", EXAMPLE.read_text())
    return "".join(f"{line.rstrip()}\n" for line in re.sub(r"#.*", "", whole).splitlines() if line.strip())


@pytest.mark.parametrize("part", [0, 1, 2, *map(in_soak, (3, 4, 5))])
def test_a_damaged_config_is_read_or_refused_with_places(part: int, example: str, tmp_path: Path):
    path = tmp_path / "vehicle.yaml"
    refused = 0
    for number in range(part * COUNT // 6, (part + 1) * COUNT // 6):
        dice = random.Random(number)
        damaged = dice.choice(MUTATIONS)(example, dice)
        content = damaged.encode("utf-8", "surrogatepass")
        if dice.random() < 0.1:
            content = content.replace(b"veh1", bytes([dice.randrange(256), dice.randrange(256)]))
        path.write_bytes(content)
        try:
            config = load_config(path)
        except ConfigError as error:
            refused += 1
            for fault in error.faults:
                assert FAULT.fullmatch(fault) or "cannot be read" in fault, f"{number}: {fault!r}"
                fault.encode()  # can be printed
                assert len(fault) < 1000, f"{number}: {fault!r}"
        else:
            mountings(config.sensors), mounted_upside_down(config.sensors), mapped_lasers(config)
    assert refused > COUNT / 6 / 2


@pytest.mark.parametrize("path", ["/dev/zero", "/dev/null", "/", "a\0b"])
def test_what_is_no_file_of_text_is_a_config_error(path: str):
    with pytest.raises(ConfigError):
        load_config(Path(path))


def test_a_file_that_is_too_large_says_so(tmp_path: Path):
    (tmp_path / "v.yaml").write_text("#" * (MAX_FILE_BYTES + 1))
    with pytest.raises(ConfigError, match=f"larger than {MAX_FILE_BYTES} bytes; that is no config"):
        load_config(tmp_path / "v.yaml")
