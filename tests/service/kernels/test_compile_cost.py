"""What makes kernels slow to compile, found in their source: a cold start shall take seconds, not minutes."""

import ast
from pathlib import Path

import pytest

TREE = Path(__file__).parents[3]
KERNELS = TREE / "service" / "kernels"
PACKAGE = "service.kernels."


def is_of_kernel(decorator: str) -> bool:
    return decorator.startswith(("kernel(", "seldom_kernel(", "inner_kernel", "njit("))


def checked_copies(source: str) -> list[int]:
    """Lines of kernels with `a[:] = b`: a copy by slice brings in numba's shape errors, 8 to 12 s each."""
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    kernels = [f for f in functions if any(is_of_kernel(ast.unparse(by)) for by in f.decorator_list)]
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


@pytest.mark.parametrize("module", sorted(KERNELS.glob("*.py")), ids=lambda path: path.stem)
def test_kernels_copy_by_loop(module: Path) -> None:
    lines = checked_copies(module.read_text(encoding="utf-8"))
    assert not lines, f"{module.name}: lines {lines}; use linear3.copy_vector or copy_matrix"


def decorated(module: Path, name: str) -> set[str]:
    functions = [n for n in ast.parse(module.read_text("utf-8")).body if isinstance(n, ast.FunctionDef)]
    return {f.name for f in functions if name in map(ast.unparse, f.decorator_list)}


def imported(source: str) -> set[tuple[str, str]]:
    """Module and name of every kernel that Python code takes by its name."""
    return {
        (node.module.removeprefix(PACKAGE), alias.name)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE)
        for alias in node.names
    }


def called_by_kernels(module: Path) -> set[str]:
    return {
        node.func.id
        for node in ast.walk(ast.parse(module.read_text("utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }


def test_python_calls_no_inner_kernel_and_every_inner_kernel_is_called() -> None:
    """Python that calls one ends with a segmentation fault."""
    modules = sorted(KERNELS.glob("*.py"))
    inner = {(module.stem, name) for module in modules for name in decorated(module, "inner_kernel")}
    assert ("match", "align_on_surfels") in inner
    for package in ("drivers", "service", "simulators", "tests"):
        for source in (TREE / package).rglob("*.py"):
            text = source.read_text("utf-8")
            if source.parent != KERNELS and PACKAGE in text:
                taken = imported(text) & inner
                assert not taken, f"{source.relative_to(TREE)} takes {taken}"
    called = set().union(*map(called_by_kernels, modules))
    assert {name for _, name in inner} <= called
