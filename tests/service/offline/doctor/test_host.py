import grp
from pathlib import Path

import pytest

from service.compile import cache as kernel_cache
from service.offline.doctor.host import look_at_cache, look_at_clock, look_at_rights, look_at_unit
from service.offline.doctor.machine import KernelClock
from tests.service.offline.doctor.conftest import FakeTree

GROUP = grp.struct_group(("dialout", "x", 20, ["member"]))


@pytest.mark.parametrize(
    ("clock", "severity", "words"),
    [
        (KernelClock(True, 0.004), "ok", "synchronised, at most 4 ms off"),
        (KernelClock(True, 12.0), "ok", "at most 12 s off"),
        (KernelClock(False, 16.0), "note", "not synchronised"),
        (None, "note", "unknown"),
    ],
)
def test_the_clock_is_what_the_kernel_says(
    tree: FakeTree, clock: KernelClock | None, severity: str, words: str
):
    finding = look_at_clock(tree.machine(kernel_clock=lambda: clock))
    assert finding.severity == severity
    assert words in finding.measured
    assert "no time daemon runs" in finding.measured


def test_who_keeps_the_time_is_named(tree: FakeTree):
    tree.process(9, "chronyd", "/usr/sbin/chronyd")
    assert "chronyd runs" in look_at_clock(tree.machine()).measured


def test_a_clock_that_starts_in_1970_is_a_fault(tree: FakeTree):
    finding = look_at_clock(tree.machine(unix_s=lambda: 3600.0))
    assert finding.severity == "fault"
    assert "before 2025" in finding.measured


@pytest.mark.parametrize(
    ("changes", "severity", "words"),
    [
        ({"is_root": True}, "ok", "root may open every port"),
        ({"group_ids": frozenset({20})}, "ok", "user driver is in group dialout"),
        ({"user": "member"}, "note", "was added after this login"),
        ({}, "note", "user driver is not in group dialout"),
    ],
)
def test_rights_on_serial_ports_go_by_group(
    tree: FakeTree, monkeypatch: pytest.MonkeyPatch, changes: dict[str, object], severity: str, words: str
):
    monkeypatch.setattr(grp, "getgrnam", lambda name: GROUP)
    finding = look_at_rights(tree.machine(**changes))
    assert finding.severity == severity
    assert words in finding.measured


def test_the_unit_is_missing_there_or_enabled(tree: FakeTree):
    assert "is not installed" in look_at_unit(tree.machine()).measured
    tree.write("/etc/systemd/system/corridor@.service", "")
    assert "enabled for no vehicle" in look_at_unit(tree.machine()).measured
    tree.link("/etc/systemd/system/multi-user.target.wants/corridor@veh1.service", "../corridor@.service")
    finding = look_at_unit(tree.machine())
    assert finding.severity == "ok"
    assert "enabled: corridor@veh1.service" in finding.measured


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "numba"


def test_a_cache_is_good_once_all_is_compiled_and_until_a_source_changes(
    tree: FakeTree, place: Path, monkeypatch: pytest.MonkeyPatch
):
    environment = {"NUMBA_CACHE_DIR": str(place)}
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(place))
    kernel_cache.ensure_cache_dir()
    kernel_cache.cache_folder().mkdir()
    for name in ("one", "two"):
        (kernel_cache.cache_folder() / f"deskew.{name}-1.py311.nbi").touch()
    assert look_at_cache(tree.machine(environment=environment)).measured.startswith("2 kernels ")
    kernel_cache.mark_warm()
    finding = look_at_cache(tree.machine(environment=environment))
    assert (finding.severity, finding.values["kernels"]) == ("ok", 2)
    monkeypatch.setattr(kernel_cache, "cache_key", lambda: "of other sources")
    finding = look_at_cache(tree.machine(environment=environment))
    assert finding.severity == "note"
    assert finding.measured.startswith("0 kernels ")
