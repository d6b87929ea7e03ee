"""YAML with the line and column of every value, and none of YAML 1.1's surprises.

PyYAML alone reads `no` as False, `012` as 10, `1:30` as 90 and `1e3` as text, and lets a second key of the
same name win in silence. Here each of those is a fault that names its place and says what to write instead.
"""

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import yaml

Path = tuple[str | int, ...]
MAX_FILE_BYTES = 1_000_000  # a config of thirty sensors has 10 kB; /dev/zero has no end
MAX_DEPTH = 20  # a config is 4 deep; an alias to its own parent would be endless
MAX_VALUES = 10_000  # aliases of aliases multiply

_TOO_MANY = f"more than {MAX_VALUES} values; aliases of aliases?"
_LOOKS_LIKE_A_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+|0o[0-7]+|\d+(_\d+)+")
_OCTAL = re.compile(r"[-+]?0[0-9_]+")
_BOOLS = {"true": True, "false": False}
_NOT_TEXT = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")  # tab and new line are text
_PLAIN_TAGS = ("tag:yaml.org,2002:map", "tag:yaml.org,2002:seq")
_LARGEST_INT = 2**63 - 1
_SHOWN_CHARS = 60


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
        return where + (f"{dotted(self.path)}: " if self.path else "") + self.message.replace("\n", " ")


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
        loader = _Loader(text)
    except yaml.YAMLError as error:  # a character YAML forbids; the reader has no mark
        line = text.count("\n", 0, getattr(error, "position", 0)) + 1
        document.faults.append(Fault(Position(line, 1), (), f"not YAML: {error}".splitlines()[0]))
        return document
    try:
        root = loader.get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        position = Position(mark.line + 1, mark.column + 1) if mark else Position(1, 1)
        problem = ", ".join(part for part in (error.context, error.problem) if part)
        advice = "; write spaces in place of the tab" if "\\t" in problem else ""
        document.faults.append(Fault(position, (), f"not YAML: {problem}{advice}"))
        return document
    except (ValueError, OverflowError) as error:  # PyYAML lets those of chr() and int() through
        mark = loader.get_mark()
        position = Position(mark.line + 1, mark.column + 1)
        document.faults.append(Fault(position, (), f"not YAML: {error}"))
        return document
    if root is not None:
        document.value = _value(root, (), document, MAX_DEPTH)
    return document


class _Loader(yaml.SafeLoader):
    """Stops at MAX_DEPTH. PyYAML calls itself for each level, until the interpreter gives up."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self._depth > MAX_DEPTH:
            mark = self.get_mark()
            raise yaml.composer.ComposerError(None, None, f"nested deeper than {MAX_DEPTH} levels", mark)
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1


def _value(node: yaml.Node, path: Path, document: Document, depth: int) -> Any:
    document.positions.setdefault(path, _position(node))
    if len(document.positions) > MAX_VALUES:
        if not document.faults or document.faults[-1].message != _TOO_MANY:
            _fault(document, node, (), _TOO_MANY)
        return None
    if depth == 0:
        return _fault(document, node, path, f"nested deeper than {MAX_DEPTH} levels; an alias inside itself?")
    if not isinstance(node, yaml.ScalarNode) and node.tag not in _PLAIN_TAGS:
        _fault(document, node, path, f"tags such as {_shown(node.tag)} are not read here")
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
        if _NOT_TEXT.search(key) or "\n" in key:
            _fault(document, key_node, path, f"the key {_shown(key)} holds a control character")
            continue
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
    if _NOT_TEXT.search(text):
        return _fault(document, node, path, f"{_shown(text)} holds a control character; write plain text")
    quoted, shown = node.style is not None, _shown(text)
    match kind:
        case "str":
            if not quoted and _LOOKS_LIKE_A_NUMBER.fullmatch(text):
                return _fault(
                    document, node, path, f"YAML takes {shown} for text; write {_plain(text)}, or quote it"
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
                    f'YAML takes {shown} for {meant}; write {meant}, or quote it: "{shown}"',
                )
            return _BOOLS[text]
        case "int" if ":" in text:
            return _fault(
                document, node, path, f'YAML takes {shown} for a base-60 number; quote it: "{shown}"'
            )
        case "int" if "_" in text or text.lower().lstrip("+-").startswith(("0b", "0x")):
            return _fault(document, node, path, f'write {_plain(text)}, or quote it: "{shown}"')
        case "int" if _OCTAL.fullmatch(text):
            meant = text.lstrip("+-").lstrip("0") or "0"
            return _fault(
                document, node, path, f'YAML takes {shown} for octal; write {meant}, or quote it: "{shown}"'
            )
        case "int":
            return _int(text, node, path, document)
        case "float":
            return _float(text, node, path, document)
        case "timestamp":
            return _fault(document, node, path, f'YAML takes {shown} for a date; quote it: "{shown}"')
        case _:
            return _fault(document, node, path, f"tags such as {_shown(node.tag)} are not read here")


def _int(text: str, node: yaml.Node, path: Path, document: Document) -> int | None:
    try:
        value = int(text, 0)  # refuses more than 4300 digits
    except ValueError:
        _fault(document, node, path, f"{_shown(text)} is no whole number in plain digits")
        return None
    if abs(value) > _LARGEST_INT:
        _fault(document, node, path, f"{_shown(text)} is beyond 64 bits")
        return None
    return value


def _float(text: str, node: yaml.Node, path: Path, document: Document) -> float | None:
    try:
        value = float(text)
    except ValueError:
        value = math.nan  # .inf, .nan, 1:30.5 and 1_0.5
    if not math.isfinite(value):
        _fault(document, node, path, f"{_shown(text)} is not a finite number in plain decimals")
        return None
    return value


def _plain(text: str) -> str:
    """The number that was meant, in a spelling every YAML reads the same."""
    digits = text.replace("_", "")
    try:
        if digits.lower().lstrip("+-").startswith(("0o", "0b", "0x")):
            return _shown(str(int(digits, 0)))
        value = float(digits)
    except ValueError:
        return "a plain number"
    if not math.isfinite(value):
        return "a number that is not beyond all bounds"
    if value.is_integer() and abs(value) < 1e15:
        return str(int(value)) if "_" in text else f"{value:.1f}"
    return f"{value:.12f}".rstrip("0") if 1e-6 < abs(value) < 1e15 else repr(value)


def _fault(document: Document, node: yaml.Node, path: Path, message: str) -> None:
    document.faults.append(Fault(_position(node), path, message))


def _shown(text: str) -> str:
    """Printable wherever faults are printed, and no longer than a line."""
    if not _NOT_TEXT.search(text) and "\n" not in text:
        return text if len(text) <= _SHOWN_CHARS else f"{text[:_SHOWN_CHARS]}..."
    return json.dumps(text[:_SHOWN_CHARS])


def _position(node: yaml.Node) -> Position:
    return Position(node.start_mark.line + 1, node.start_mark.column + 1)
