"""CONTRIBUTING.md to the letter: its driver, sink and matcher, added to a copy of the tree."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import pytest

from tests.docs.blocks import ROOT

PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
WHOLE_FILE = re.compile(r"`([\w/]+\.py)`[^`]*\n\n *```python\n(.*?)```", re.DOTALL)
COPIED = ("drivers", "service", "simulators", "config")
CONFIG = """\
vehicle: veh1
sensors:
  front: {type: line_laser, host: 192.168.0.1}
mapping: {profile: corridor, components: {matcher: as_predicted}}
recording: {directory: sessions}
map: {directory: maps}
udp: {host: 127.0.0.1}
"""


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tree = tmp_path_factory.mktemp("tree")
    for name in COPIED:
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tree)
    (tree / "tests" / "drivers").mkdir(parents=True)
    shutil.copy(ROOT / "tests" / "drivers" / "virtual_time.py", tree / "tests" / "drivers")
    for path, code in WHOLE_FILE.findall(PAGE):
        (tree / path).parent.mkdir(exist_ok=True)
        (tree / path).write_text(dedent(code), encoding="utf-8")
    (tree / "drivers" / "line_laser" / "__init__.py").touch()
    for registry in ("drivers/registry.py", "simulators/registry.py"):
        line = re.search(rf'^{registry} +(".*)$', PAGE, re.MULTILINE)
        insert(tree / registry, '"sick_lms100":', line[1].replace("<type>", "line_laser") + "\n    ")
    sink = re.search(r"^ +(SinkKind\(.*\),)$", PAGE, re.MULTILINE)
    insert(tree / "service/sinks/registry.py", "SinkKind(\n", sink[1] + "\n    ")
    method = "service/mapper/methods/corridor/method.py"
    imported, offered = re.findall(rf"^{method} +(.*)$", PAGE, re.MULTILINE)
    insert(tree / method, "from service", imported + "\n")
    text = (tree / method).read_text(encoding="utf-8")
    (tree / method).write_text(text.replace("others={", offered + " "), encoding="utf-8")
    return tree


def insert(path: Path, before: str, line: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert before in text
    path.write_text(text.replace(before, line + before, 1), encoding="utf-8")


def run(tree: Path, *command: str) -> str:
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_config_with_all_three_is_valid(tree: Path):
    (tree / "vehicle.yaml").write_text(CONFIG)
    assert "vehicle.yaml" in run(tree, sys.executable, "-m", "service", "check", "vehicle.yaml")


def test_the_tests_of_the_example_pass(tree: Path):
    scratch = f"--basetemp={tree / 'scratch'}"
    run(tree, sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", scratch, "tests")


def test_the_examples_keep_the_rules_of_the_tree(tree: Path):
    beside = Path(sys.executable).parent
    new = [path for path, _ in WHOLE_FILE.findall(PAGE)]
    assert len(new) == 9
    run(tree, str(beside / "ruff"), "check", "--no-cache", *new)
    run(tree, str(beside / "ruff"), "format", "--no-cache", "--check", *new)
    run(tree, str(beside / "lint-imports"), "--no-cache")
