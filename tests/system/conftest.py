"""Fixtures that end their processes."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest

from tests.demo_run import DemoRun, run_demo
from tests.system.installed import build_wheel, environment, install
from tests.system.machine import FakeVehicle, Subscriber

DEMO_S = 7


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="session")
def corridor(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command, installed from the wheel."""
    return install(wheel, tmp_path_factory.mktemp("installed"))


@pytest.fixture(scope="session")
def demo_run(corridor: Path, tmp_path_factory: pytest.TempPathFactory) -> DemoRun:
    """One demo of the installed command, whose files several tests read."""
    folder = tmp_path_factory.mktemp("demo")
    return run_demo(DEMO_S, folder, program=corridor, environment=environment())


@pytest.fixture
def fake_vehicle(tmp_path: Path) -> Iterator[FakeVehicle]:
    vehicle = FakeVehicle(tmp_path)
    vehicle.start()
    yield vehicle
    vehicle.stop()


@pytest.fixture
def subscribe() -> Iterator[Callable[[str], Subscriber]]:
    opened = []

    def open_one(endpoint: str, settings: Mapping[str, Any] = MappingProxyType({})) -> Subscriber:
        opened.append(Subscriber(endpoint, settings))
        return opened[-1]

    yield open_one
    for subscriber in opened:
        subscriber.close()
