from concurrent.futures import ThreadPoolExecutor, wait

from service.encoding import Status, encode_diagnostics
from service.mapstore.tiles import TileStore
from service.offline.doctor.processes import Process
from service.offline.doctor.running import RunningService, ask_health, from_health
from service.publishing.config import PublishingConfig
from service.publishing.security import SecurityConfig
from service.publishing.zenoh_publisher import ZenohPublisher
from tests.service.publishing.conftest import site, tls

__all__ = ["site"]  # a fixture

STATUSES = [
    Status("sensor/front", 0, "streaming", {"rate_hz": "49.7"}),
    Status("sensor/base", 2, "no answer to Start (128) in 8 s", {}),
    Status("mapping", 1, "no scan mapped yet", {}),
]
PROCESS = Process(41, "corridor", ("corridor", "run"))


def test_each_status_becomes_a_finding():
    running = RunningService(PROCESS, "tcp/127.0.0.1:7447")
    front, base, mapping, rear = from_health(running, "veh1", ["front", "base", "rear"], STATUSES)
    assert (front.severity, front.who) == ("ok", "front")
    assert front.measured == "as the running service reports: streaming; 49.7 frames/s"
    assert (base.severity, base.who) == ("fault", "base")
    assert "stop the service" in base.remedy
    assert (mapping.severity, mapping.who) == ("note", "mapping")
    assert (rear.severity, rear.who) == ("note", "rear")
    assert "knows no such sensor" in rear.measured


def test_a_service_without_health_is_a_fault():
    (finding,) = from_health(RunningService(PROCESS, "tcp/127.0.0.1:7447"), "veh1", ["front"], [])
    assert finding.severity == "fault"
    assert "no health of vehicle veh1 comes" in finding.measured


def test_health_is_read_over_tls_from_an_endpoint_at_every_address(site):
    files = tls(site, "veh1")
    security = SecurityConfig(tls=files, roles={"vehicle": ["veh1"]})
    config = PublishingConfig(listen=("tls/127.0.0.1:0",), security=security)
    with ZenohPublisher(config, "veh1", TileStore()) as publisher, ThreadPoolExecutor(1) as worker:
        port = publisher.endpoints[0].rpartition(":")[2]
        running = RunningService(PROCESS, f"tls/0.0.0.0:{port}")
        requested = worker.submit(ask_health, running, "veh1", security, 5.0)
        for number in range(100):  # as the service does each second
            publisher.put(encode_diagnostics("health", STATUSES, number, number))
            if wait([requested], timeout=0.1).done:
                break
        assert requested.result() == STATUSES


def test_no_one_at_the_endpoint_ends_in_time(closed_port: int):
    assert ask_health(RunningService(PROCESS, f"tcp/127.0.0.1:{closed_port}"), "veh1", None, 0.3) == []
