"""What makes kernels slow to compile, found in their source: a cold start shall take seconds, not minutes."""

import ast
from pathlib import Path

import pytest

KERNELS = Path(__file__).parents[3] / "service" / "kernels"


def checked_copies(source: str) -> list[int]:
    """Lines with `a[:] = b`: a copy by slice brings in numba's shape errors, 8 to 12 s of compiling."""
    lines = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Assign) or isinstance(node.value, ast.Constant):
            continue
        for target in node.targets:
            if not isinstance(target, ast.Subscript):
                continue
            index = target.slice
            parts = index.elts if isinstance(index, ast.Tuple) else [index]
            if any(isinstance(part, ast.Slice) for part in parts):
                lines.append(node.lineno)
    return lines


def test_a_copy_by_slice_is_seen() -> None:
    assert checked_copies("a[:] = b\na[0] = b\na[:] = 0.0\na[:, 1] = c\n") == [1, 4]


@pytest.mark.parametrize("module", sorted(KERNELS.glob("*.py")), ids=lambda path: path.stem)
def test_kernels_copy_by_loop(module: Path) -> None:
    lines = checked_copies(module.read_text(encoding="utf-8"))
    assert not lines, f"{module.name}: lines {lines}; use linear3.copy_vector or copy_matrix"
