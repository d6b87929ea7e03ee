"""What makes kernels slow to compile, found in their source: a cold start shall take seconds, not minutes."""

import ast
from pathlib import Path

import pytest

KERNELS = Path(__file__).parents[3] / "service" / "kernels"


def checked_copies(source: str) -> list[int]:
    """Lines of kernels with `a[:] = b`: a copy by slice brings in numba's shape errors, 8 to 12 s each."""
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    kernels = [f for f in functions if any("njit" in ast.unparse(by) for by in f.decorator_list)]
    lines = []
    for node in (node for kernel in kernels for node in ast.walk(kernel)):
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
    body = "    a[:] = b\n    a[0] = b\n    a[:] = 0.0\n    a[:, 1] = c\n"
    assert checked_copies(f"@njit(cache=True)\ndef f(a, b, c):\n{body}") == [3, 6]
    assert checked_copies(f"def f(a, b, c):\n{body}") == []  # numpy's


@pytest.mark.parametrize("module", sorted(KERNELS.glob("*.py")), ids=lambda path: path.stem)
def test_kernels_copy_by_loop(module: Path) -> None:
    lines = checked_copies(module.read_text(encoding="utf-8"))
    assert not lines, f"{module.name}: lines {lines}; use linear3.copy_vector or copy_matrix"
