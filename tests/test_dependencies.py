"""What the packages import is what pyproject.toml declares: no more, no less."""

import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from itertools import chain
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PACKAGES = ("service", "drivers", "simulators")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NAMES = {
    "rerun": "rerun-sdk",
    "upath": "universal-pathlib",
}  # of distributions that need not be installed here
# from X.Y import, import X.Y; or, of an extra, optional("X.Y"), see service.offline
IMPORT = re.compile(
    r"(?m)^ *from (\w+)[\w.]* import |^ *import (\w+)[\w.]*(?: as \w+)? *(?:#|$)|\boptional\(\"(\w+)"
)
FOR_DEVELOPMENT = "dev"  # the extra that the packages themselves may not need


def imported() -> dict[str, str]:
    """Distribution -> a file that imports it, function bodies included."""
    distributions = packages_distributions()
    found: dict[str, str] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for top in chain.from_iterable(IMPORT.findall(path.read_text(encoding="utf-8"))):
                if top and top not in sys.stdlib_module_names and top not in PACKAGES:
                    name = distributions.get(top, [NAMES.get(top, top)])[0]
                    found.setdefault(plain(name), str(path.relative_to(ROOT)))
    return found


def plain(requirement: str) -> str:
    """The name of a distribution as PEP 503 writes it, without its versions."""
    name = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert name is not None, requirement
    return re.sub(r"[-_.]+", "-", name[0]).lower()


def test_every_import_is_declared_and_every_declaration_imported():
    found = imported()
    needed = {plain(requirement) for requirement in PROJECT["dependencies"]}
    extras = {
        plain(requirement)
        for extra, requirements in PROJECT["optional-dependencies"].items()
        if extra != FOR_DEVELOPMENT
        for requirement in requirements
    }
    undeclared = {name: file for name, file in found.items() if name not in needed | extras}
    assert not undeclared, "imported, but not in pyproject.toml"
    assert (needed | extras) - found.keys() == set(), "declared, but imported nowhere"


def test_every_dependency_has_its_reason():
    reasons = (ROOT / "docs" / "decisions" / "0001-dependencies.md").read_text().lower()
    for requirement in PROJECT["dependencies"]:
        assert f"| {plain(requirement)} |" in reasons, f"{requirement}: say in 0001-dependencies.md why"


def test_the_lock_file_has_an_allowed_version_of_every_dependency_with_hashes():
    locked: dict[str, list[str]] = {}
    for entry in re.split(r"\n(?=\S)", (ROOT / ".ci" / "lock.txt").read_text()):
        pinned = Requirement(entry.partition("\\")[0])
        assert "--hash=sha256:" in entry, pinned
        (version,) = pinned.specifier
        locked.setdefault(plain(pinned.name), []).append(version.version)
    for declared in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()):
        for requirement in map(Requirement, declared):
            versions = locked.get(plain(requirement.name), [])
            assert versions, f"{requirement}: not in .ci/lock.txt; run make lock"
            refused = [one for one in versions if one not in requirement.specifier]
            assert not refused, f"{requirement}: .ci/lock.txt has {refused}; run make lock"
