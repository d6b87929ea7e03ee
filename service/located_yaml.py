"""YAML with the line and column of every value, and none of YAML 1.1's surprises.

PyYAML alone reads `no` as False, `012` as 10, `1:30` as 90 and `1e3` as text, and lets a second key of the
same name win in silence. Here each of those is a fault that names its place and says what to write instead.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import yaml

Path = tuple[str | int, ...]
MAX_DEPTH = 20  # a config is 4 deep; an alias to its own parent would be endless
MAX_VALUES = 10_000  # aliases of aliases multiply

_TOO_MANY = f"more than {MAX_VALUES} values; aliases of aliases?"
_LOOKS_LIKE_A_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+|0o[0-7]+|\d+(_\d+)+")
_OCTAL = re.compile(r"[-+]?0[0-9_]+")
_BOOLS = {"true": True, "false": False}


@dataclass(frozen=True, slots=True)
class Position:
    """Counted from 1, as editors do."""

    line: int
    column: int


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong at one place of a document."""

    position: Position
    path: Path
    message: str

    def text(self, file: str) -> str:
        """`file:line:column: path: message`"""
        where = f"{file}:{self.position.line}:{self.position.column}: "
        return where + (f"{dotted(self.path)}: " if self.path else "") + self.message


@dataclass(slots=True)
class Document:
    """Plain values of a YAML document, where they stand, and what is wrong with the YAML itself."""

    value: Any = None
    faults: list[Fault] = field(default_factory=list)
    positions: dict[Path, Position] = field(default_factory=dict)  # a mapping's entry: of its key

    def position(self, path: Path) -> Position:
        """Of the path, or of its nearest parent where the path is not in the document."""
        while path and path not in self.positions:
            path = path[:-1]
        return self.positions.get(path, Position(1, 1))


def dotted(path: Path) -> str:
    return ".".join(str(part) for part in path)


def load(text: str) -> Document:
    """Read one YAML document. Never raises: what is wrong stands in `faults`."""
    document = Document()
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        position = Position(mark.line + 1, mark.column + 1) if mark else Position(1, 1)
        problem = ", ".join(part for part in (error.context, error.problem) if part)
        document.faults.append(Fault(position, (), f"not YAML: {problem}"))
        return document
    except yaml.YAMLError as error:  # a character YAML forbids; the reader has no mark
        line = text.count("\n", 0, getattr(error, "position", 0)) + 1
        document.faults.append(Fault(Position(line, 1), (), f"not YAML: {error}".splitlines()[0]))
        return document
    if root is not None:
        document.value = _value(root, (), document, MAX_DEPTH)
    return document


def _value(node: yaml.Node, path: Path, document: Document, depth: int) -> Any:
    document.positions.setdefault(path, _position(node))
    if len(document.positions) > MAX_VALUES:
        if not document.faults or document.faults[-1].message != _TOO_MANY:
            _fault(document, node, (), _TOO_MANY)
        return None
    if depth == 0:
        return _fault(document, node, path, f"nested deeper than {MAX_DEPTH} levels; an alias inside itself?")
    if isinstance(node, yaml.MappingNode):
        return {
            key: _value(value, (*path, key), document, depth - 1)
            for key, value in _entries(node, path, document)
        }
    if isinstance(node, yaml.SequenceNode):
        return [_value(item, (*path, index), document, depth - 1) for index, item in enumerate(node.value)]
    assert isinstance(node, yaml.ScalarNode)
    return _scalar(node, path, document)


def _entries(node: yaml.MappingNode, path: Path, document: Document) -> Iterator[tuple[str, yaml.Node]]:
    seen: dict[str, Position] = {}
    for key_node, value_node in node.value:
        if not isinstance(key_node, yaml.ScalarNode):
            _fault(document, key_node, path, "a key must be a single word")
            continue
        key = str(key_node.value)
        position = _position(key_node)
        if key_node.tag.endswith(":merge"):
            _fault(document, key_node, (*path, key), "merge keys are not read here; write the keys out")
            continue
        if key in seen:
            first = seen[key]
            message = f"this key stands already at {first.line}:{first.column}; keep one of them"
            document.faults.append(Fault(position, (*path, key), message))
            continue
        seen[key] = document.positions[(*path, key)] = position
        yield key, value_node


def _scalar(node: yaml.ScalarNode, path: Path, document: Document) -> Any:
    text, kind = str(node.value), node.tag.rpartition(":")[2]
    quoted = node.style is not None
    match kind:
        case "str":
            if not quoted and _LOOKS_LIKE_A_NUMBER.fullmatch(text):
                return _fault(
                    document, node, path, f"YAML takes {text} for text; write {_plain(text)}, or quote it"
                )
            return text
        case "null":
            return None
        case "bool":
            if text not in _BOOLS:
                meant = "true" if text.lower() in ("yes", "on", "true") else "false"
                return _fault(
                    document,
                    node,
                    path,
                    f'YAML takes {text} for {meant}; write {meant}, or quote it: "{text}"',
                )
            return _BOOLS[text]
        case "int" if ":" in text:
            return _fault(document, node, path, f'YAML takes {text} for a base-60 number; quote it: "{text}"')
        case "int" if "_" in text or text.lower().lstrip("+-").startswith("0b"):
            return _fault(document, node, path, f'write {_plain(text)}, or quote it: "{text}"')
        case "int" if _OCTAL.fullmatch(text):
            meant = text.lstrip("+-").lstrip("0") or "0"
            return _fault(
                document, node, path, f'YAML takes {text} for octal; write {meant}, or quote it: "{text}"'
            )
        case "int":
            return int(text, 0)
        case "float":
            return _float(text, node, path, document)
        case "timestamp":
            return _fault(document, node, path, f'YAML takes {text} for a date; quote it: "{text}"')
        case _:
            return _fault(document, node, path, f"tags such as {node.tag} are not read here")


def _float(text: str, node: yaml.Node, path: Path, document: Document) -> float | None:
    try:
        value = float(text)
    except ValueError:
        value = math.nan  # .inf, .nan, 1:30.5 and 1_0.5
    if not math.isfinite(value):
        _fault(document, node, path, f"{text} is not a finite number in plain decimals")
        return None
    return value


def _plain(text: str) -> str:
    """The number that was meant, in a spelling every YAML reads the same."""
    digits = text.replace("_", "")
    if digits.startswith("0o"):
        return str(int(digits, 8))
    if digits.lower().lstrip("+-").startswith("0b"):
        return str(int(digits, 2))
    value = float(digits)
    if value.is_integer() and abs(value) < 1e15:
        return str(int(value)) if "_" in text else f"{value:.1f}"
    return f"{value:.12f}".rstrip("0") if 1e-6 < abs(value) < 1e15 else repr(value)


def _fault(document: Document, node: yaml.Node, path: Path, message: str) -> None:
    document.faults.append(Fault(_position(node), path, message))


def _position(node: yaml.Node) -> Position:
    return Position(node.start_mark.line + 1, node.start_mark.column + 1)
