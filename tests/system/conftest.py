"""Machines that are always switched off again."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.system.machine import FakeVehicle, LiveService, Subscriber


@pytest.fixture
def fake_vehicle(tmp_path: Path) -> Iterator[FakeVehicle]:
    vehicle = FakeVehicle(tmp_path)
    vehicle.start()
    yield vehicle
    vehicle.stop()


@pytest.fixture
def live_service(fake_vehicle: FakeVehicle, tmp_path: Path) -> Iterator[LiveService]:
    service = LiveService(tmp_path, fake_vehicle.sensors())
    service.start()
    yield service
    service.close()


@pytest.fixture
def subscribe() -> Iterator[Callable[[str], Subscriber]]:
    opened = []

    def open_one(endpoint: str) -> Subscriber:
        opened.append(Subscriber(endpoint))
        return opened[-1]

    yield open_one
    for subscriber in opened:
        subscriber.close()
