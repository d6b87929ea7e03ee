"""A vehicle's link to its site over loopback: what goes over it, and when it is refused."""

import time
from collections import Counter

from service.cli import main
from service.encoding import ERROR, OK, WARNING, encode_frame, encode_pose
from service.publishing.commands import Answer
from service.publishing.uplink import PRESENCES, presences
from service.sinks import fleet_sink
from service.sinks.fleet_sink import LOOK_S, FleetSink
from tests.service.fleet.conftest import diagnostics, is_in_fleet
from tests.service.mapstore.tile_makers import tile
from tests.service.publishing.conftest import Inbox
from tests.service.publishing.test_ros2_topics import SCAN
from tests.service.test_encoding_outputs import OUTPUT
from tests.waiting import wait_until

VEH1 = "corridor/v1/veh1"


def answers(client, key: str = "veh1/cmd/any") -> list[str]:
    return [reply.ok.payload.to_string() for reply in client.get(f"corridor/v1/{key}", timeout=20.0)]


def subscribed(client, key: str) -> Inbox:
    """The router knows of it, and so do vehicles: an answer comes after the declaration."""
    inbox = Inbox()
    client.declare_subscriber(key, inbox)
    assert answers(client)
    return inbox


def test_poses_go_out_at_the_rate_of_the_policy_and_scans_never(endpoint, start_vehicle, client):
    sink = start_vehicle(endpoint, fleet={"pose_hz": 20.0, "health_hz": 1.0})
    inbox = subscribed(client, "corridor/v1/**")
    began_s = time.monotonic()
    for number in range(100):
        sink.put(encode_pose(OUTPUT, number))
        sink.put(encode_frame(SCAN))
        sink.put(diagnostics(stamp_ns=number + 1))
        time.sleep(0.005)  # the rate of the input is what is tested
    duration_s = time.monotonic() - began_s
    sink.put_tiles([tile(0, 0, 1)], 1, 1)  # goes out after them
    inbox.wait_for_one(lambda sample: "/map/tile/" in str(sample.key_expr))
    channels = [str(sample.key_expr).removeprefix(f"{VEH1}/") for sample in inbox.samples]
    assert 0.5 * 20 * duration_s <= channels.count("pose") <= 20 * duration_s + 2
    assert 1 <= channels.count("health") <= duration_s + 2
    assert set(channels) <= {"pose", "health", "map/meta", "map/tile/0/0/0"}


def test_without_a_subscriber_no_tile_is_sent(endpoint, start_vehicle, client):
    sink = start_vehicle(endpoint)
    for version in range(1, 20):
        sink.put_tiles([tile(version, 0, version)], 1, 1)
    inbox = subscribed(client, f"{VEH1}/map/tile/**")
    wait_until(lambda: sink.put_tiles([tile(0, 0, 20)], 1, 1) or inbox.samples)
    assert {str(sample.key_expr) for sample in inbox.samples} == {f"{VEH1}/map/tile/0/0/0"}
    assert int(sink.health().values.get("sent.map/tile", "0")) < 19


def test_the_bytes_that_the_kernel_counts_are_in_health(endpoint, start_vehicle, client):
    sink = start_vehicle(endpoint)
    inbox = subscribed(client, f"{VEH1}/map/tile/**")
    before = int(sink.health().values["bytes_sent"])
    sink.put_tiles([tile(0, 0, 1, edge=64)], 1, 1)
    inbox.wait_for(1)
    wait_until(lambda: int(sink.health().values["bytes_sent"]) >= before + 4096)  # random cells: not packed
    assert sink.health().level == OK
    assert sink.health().values["links"] == "1"


def test_commands_come_through_the_router_unless_they_are_switched_off(endpoint, start_vehicle, client):
    for vehicle, commands in (("veh1", True), ("veh2", False)):
        start_vehicle(
            endpoint,
            vehicle,
            fleet={"commands": commands},
            command=lambda verb, payload: Answer(True, verb.encode()),
        )
    wait_until(lambda: answers(client, "veh1/cmd/pause") == ["pause"])
    assert answers(client, "veh2/cmd/pause") == []


def test_a_lost_link_comes_back_with_what_was_declared(endpoint, start_router, start_vehicle, open_client):
    router = start_router(endpoint)
    sink = start_vehicle(endpoint, command=lambda verb, payload: Answer(True, b"{}"))
    router.close()
    wait_until(lambda: "no link" in sink.health().message)
    start_router(endpoint)
    wait_until(lambda: sink.health().level == OK)
    assert sink.health().values["links"] == "2"
    client = open_client(endpoint)
    wait_until(lambda: answers(client) == ["{}"])


def test_a_vehicle_without_its_router_looks_for_it_once_a_second(
    endpoint, start_router, start_vehicle, monkeypatch
):
    """The router's end is a change of who is in the fleet, which is decided once it is back: until then the
    thread must not take the processor from those that read devices.
    """
    looks, look = Counter(), FleetSink._look
    monkeypatch.setattr(FleetSink, "_look", lambda self, *link: (looks.update([link[0]]), look(self, *link)))
    router = start_router(endpoint)
    sink = start_vehicle(endpoint)
    router.close()
    wait_until(lambda: looks[""] >= 2)
    began_s = time.monotonic()
    start_router(endpoint)
    wait_until(lambda: sink.health().level == OK)
    assert looks[""] <= 10 + 2 * (time.monotonic() - began_s) / LOOK_S


def test_of_two_vehicles_by_one_name_the_later_is_refused_with_both_addresses(
    endpoint, start_vehicle, client, monkeypatch, site_file, capsys
):
    """Also where its clock is years behind: a battery that was changed at night takes no vehicle away."""
    first = start_vehicle(endpoint, command=lambda verb, payload: Answer(True, b"first"))
    with monkeypatch.context() as clock:
        clock.setattr(fleet_sink.time, "time_ns", lambda: 1_000_000_000)
        second = start_vehicle(endpoint, waits=False, command=lambda verb, payload: Answer(True, b"second"))
    wait_until(lambda: second.health().level == ERROR)
    keys = [str(reply.ok.key_expr) for reply in client.liveliness().get(PRESENCES, timeout=20.0)]
    both = presences(keys)["veh1"]
    assert len(both) == 2
    words = f"{both[0]} was first, {both[1]} is refused; give one another name"
    assert second.health().message.endswith(words)
    wait_until(lambda: first.health().level == WARNING)
    assert first.health().message.endswith(words)
    assert main(["fleet", "status", "--site", site_file]) == 1
    assert f"2 vehicles by this name: {both[0]} is in the fleet, {both[1]} refused" in capsys.readouterr().out
    assert answers(client) == ["first"]
    first.close()
    wait_until(lambda: is_in_fleet(second))
    assert second.health().level == OK
    wait_until(lambda: answers(client) == ["second"])  # once the router knows of its commands


def test_a_vehicle_may_not_speak_by_the_name_of_another(start_router, start_vehicle, endpoint, client_of):
    secured = endpoint.replace("tcp", "tls")
    start_router(secured)
    start_vehicle(secured, "veh2", certificate="veh1")  # it cannot know: its declarations go nowhere
    start_vehicle(secured, "veh1", command=lambda verb, payload: Answer(True, b"{}"))
    operator = client_of(secured, "operator")
    assert list(operator.get(f"{VEH1}/cmd/any", timeout=20.0))
    assert not list(operator.get("corridor/v1/veh2/cmd/any", timeout=20.0))
