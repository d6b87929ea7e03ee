"""docs/constants.md: `python -m tests.docs.constants` writes it from the code."""

import ast
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "constants.md"
FOLDERS = ("timing", "estimator", "mapper", "kernels")  # of service: what a scan passes
INTRODUCTION = """\
# Constants of the mapper

Numbers of the default profile that no setting changes: limits, noise, sizes. Settings are in
[configuration](configuration.md), constants of equations (`service/kernels/`) in
[the estimator](estimator.md).
`.venv/bin/python -m tests.docs.constants` writes this page.

| file | constant | value | meaning |
|---|---|---|---|
"""


class Constant(NamedTuple):
    name: str
    value: str  # as it is written
    meaning: str  # the comment behind it, else the one above


def constants_by_file() -> dict[str, list[Constant]]:
    """Path below service/ -> its constants, as they stand."""
    files = (path for folder in FOLDERS for path in sorted((ROOT / "service" / folder).rglob("*.py")))
    found = {
        str(path.relative_to(ROOT / "service")): list(_constants_of(path))
        for path in files
        if "papers" not in path.parts
    }
    return {file: constants for file, constants in found.items() if constants}


def page() -> str:
    return INTRODUCTION + "".join(
        f"| {file} | {names} | {values} | {meaning} |\n"
        for file, constants in constants_by_file().items()
        if not file.startswith("kernels/")
        for names, values, meaning in _rows(constants)
    )


def _rows(constants: list[Constant]) -> Iterator[tuple[str, str, str]]:
    """Names, values and meaning; constants that one comment explains share a row."""
    for meaning, group in groupby(constants, lambda one: one.meaning):
        if meaning:
            names, values, _ = zip(*group, strict=True)
            yield _listed(names), _listed(values), meaning


def _listed(words: tuple[str, ...]) -> str:
    return ", ".join(f"`{word}`" for word in words)


def _constants_of(path: Path) -> Iterator[Constant]:
    text = path.read_text()
    lines = text.splitlines()
    for node in ast.parse(text).body:
        match node:
            case ast.Assign(targets=[target], value=value) if _is_number(value):
                meaning = _comment_of(lines, node)
                for name, part in _pairs(target, value):
                    if name.isupper():
                        yield Constant(name, ast.unparse(part).replace("|", "\\|"), meaning)


def _pairs(target: ast.expr, value: ast.expr) -> list[tuple[str, ast.expr]]:
    """(name, value) of each in `A, B = 1, 2`."""
    match target, value:
        case ast.Name(), _:
            return [(target.id, value)]
        case ast.Tuple(elts=names), ast.Tuple(elts=values) if len(names) == len(values):
            return [(n.id, part) for n, part in zip(names, values, strict=True) if isinstance(n, ast.Name)]
        case ast.Tuple(elts=names), _:
            return [(name.id, value) for name in names if isinstance(name, ast.Name)]
    return []


def _is_number(value: ast.expr) -> bool:
    """Whether a number stands in it, and no text."""
    constants = [node.value for node in ast.walk(value) if isinstance(node, ast.Constant)]
    has_text = any(isinstance(constant, str | bytes) for constant in constants)
    return not has_text and any(type(constant) in (int, float) for constant in constants)


def _comment_of(lines: list[str], node: ast.Assign) -> str:
    """Behind the last line, else behind any, else above."""
    assert node.end_lineno is not None
    own = lines[node.lineno - 1 : node.end_lineno]
    behind = next((comment for line in reversed(own) if (comment := line.partition("  # ")[2])), "")
    above: list[str] = []
    for line in reversed(lines[: node.lineno - 1]):
        if not line.startswith("# "):
            break
        above.insert(0, line.removeprefix("# "))
    return (behind or " ".join(above)).replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page())
