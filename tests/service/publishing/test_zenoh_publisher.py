import os
import signal
import subprocess
import sys
import threading
import time

import pytest
import zenoh
import zenoh.ext

from drivers.rmw_zenoh import Attachment
from service.encoding import Message, decode_diagnostics, decode_grid, encode_tile
from service.errors import StorageError
from service.publishing.config import PublishingConfig
from tests.service.mapstore.tile_makers import tile
from tests.service.publishing.conftest import TIMEOUT_S, Inbox
from tests.waiting import wait_until

ROOT = "corridor/v1/veh1"
ODOMETRY = "nav_msgs/msg/Odometry"


def message(channel: str, number: int, payload: bytes = b"\x00\x01\x00\x00pose") -> Message:
    return Message(channel, ODOMETRY, number, 1_700_000_000_000_000_000 + number, payload)


def attachment_of(sample: zenoh.Sample) -> Attachment:
    return Attachment.decode(sample.attachment.to_bytes())


def get(session: zenoh.Session, selector: str) -> list[zenoh.Sample]:
    replies = session.get(f"{ROOT}/{selector}", consolidation=zenoh.ConsolidationMode.NONE, timeout=TIMEOUT_S)
    return [reply.ok for reply in replies if reply.ok is not None]


def subscribe(session: zenoh.Session, publisher, key: str, inbox: Inbox) -> zenoh.Subscriber:
    """Subscribed, and the publisher's router knows it: the answer to a get comes after the declaration."""
    subscriber = session.declare_subscriber(f"{ROOT}/{key}", inbox)
    get(session, "pose")
    return subscriber


def test_a_message_arrives_with_type_sequence_time_and_gid(publisher, client):
    inbox = Inbox()
    subscribe(client, publisher, "**", inbox)
    for number in range(3):
        publisher.put(message("pose", number))
    publisher.put(message("front/scan", 9, payload=b"scan"))
    samples = inbox.wait_for(4)
    poses = [s for s in samples if str(s.key_expr) == f"{ROOT}/pose"]
    assert [s.payload.to_bytes() for s in poses] == [b"\x00\x01\x00\x00pose"] * 3
    assert {str(s.encoding) for s in poses} == {f"application/cdr;{ODOMETRY}"}
    attachments = [attachment_of(s) for s in poses]
    assert [(a.sequence, a.source_ns) for a in attachments] == [
        (i + 1, 1_700_000_000_000_000_000 + i) for i in range(3)
    ]
    (scan,) = [s for s in samples if str(s.key_expr) == f"{ROOT}/front/scan"]
    assert attachment_of(scan).sequence == 1
    assert len({a.gid for a in attachments}) == 1
    assert attachment_of(scan).gid != attachments[0].gid
    wait_until(lambda: publisher.counts()["sent"] == {"pose": 3, "front/scan": 1})


def test_fresh_things_go_first_and_bulk_last(publisher, client, store):
    inbox = Inbox()
    subscribe(client, publisher, "**", inbox)
    for channel in ("pose", "odom", "tf", "front/scan", "base/odom", "events"):
        publisher.put(message(channel, 1))
    store.update([tile(0, 0, 1)])
    publisher.map_changed([tile(0, 0, 1)], 1, 1)

    def quality(channel: str) -> tuple[object, ...]:
        sample = inbox.wait_for_one(lambda sample: str(sample.key_expr) == f"{ROOT}/{channel}")
        return sample.priority, sample.express, sample.congestion_control

    drop = zenoh.CongestionControl.DROP
    for channel in ("pose", "odom", "tf", "front/scan", "base/odom"):
        assert quality(channel) == (zenoh.Priority.DATA_HIGH, True, drop)
    assert quality("events") == (zenoh.Priority.DATA, False, drop)
    for channel in ("map", "map/tile/0/0/0"):
        assert quality(channel) == (zenoh.Priority.DATA_LOW, False, drop)


def test_latency_is_reported_for_what_has_an_origin(open_publisher):
    facts, done = [], threading.Event()

    def note(latency_ns: int) -> None:
        facts.append(latency_ns)
        done.set()

    publisher = open_publisher(on_latency=note)
    publisher.put(message("front/scan", 1))
    publisher.put(message("pose", 1), origin_ns=time.monotonic_ns() - 5_000_000)
    assert done.wait(TIMEOUT_S)
    publisher.close()
    assert len(facts) == 1
    assert 5_000_000 <= facts[0] < 2_000_000_000


def test_a_late_joiner_gets_the_last_pose_and_state(publisher, client):
    for number in (1, 2):
        publisher.put(message("pose", number))
        publisher.put(message("tf_static", number, payload=b"tf"))
        publisher.put(message("map/changes", number, payload=b"changed"))
        publisher.put(message("health", number, payload=b"health"))
    wait_until(
        lambda: (
            publisher.counts()["sent"]["pose"] == 2
            and publisher.counts()["sent"]["health"]
            and publisher.counts()["sent"]["tf_static"]
        )
    )
    assert [(s.payload.to_bytes(), attachment_of(s).sequence) for s in get(client, "pose")] == [
        (b"\x00\x01\x00\x00pose", 2)
    ]
    assert [s.payload.to_bytes() for s in get(client, "tf_static")] == [b"tf"]
    wait_until(lambda: publisher.counts()["sent"]["map/changes"] >= 1)
    assert [s.payload.to_bytes() for s in get(client, "map/changes")] == [b"changed"]
    assert [s.payload.to_bytes() for s in get(client, "health")] == [b"health"]


def test_what_is_not_there_yet_is_answered_by_nothing_at_once(publisher, client):
    began_s = time.monotonic()
    assert [get(client, key) for key in ("pose", "map", "map/meta", "map/tile/**")] == [[], [], [], []]
    assert time.monotonic() - began_s < TIMEOUT_S  # which one that no one answers takes


def test_changed_tiles_arrive_with_their_version(publisher, client, store):
    inbox = Inbox()
    subscribe(client, publisher, "map/tile/**", inbox)
    tiles = [tile(-3, 2, 7), tile(0, 0, 8, level=1)]
    store.update(tiles)
    publisher.map_changed(tiles, 1, 2)
    samples = {str(s.key_expr): s for s in inbox.wait_for(2)}
    for t in tiles:
        sample = samples[f"{ROOT}/map/tile/{t.level}/{t.ix}/{t.iy}"]
        assert attachment_of(sample).sequence == t.version
        assert attachment_of(sample).source_ns == 2
        assert sample.payload.to_bytes() == encode_tile(t, 1, 2).payload


def test_tiles_are_answered_since_a_version_and_by_key(publisher, client, store):
    tiles = [tile(ix, iy, 1 + ix + 3 * iy) for iy in range(3) for ix in range(3)]
    store.update(tiles)
    publisher.map_changed([], 1, 2)

    def versions(selector: str) -> list[int]:
        return sorted(attachment_of(s).sequence for s in get(client, selector))

    assert versions("map/tile/**") == versions("map/tile/**?since=0") == list(range(1, 10))
    assert versions("map/tile/**?since=6") == [7, 8, 9]
    assert versions("map/tile/**?since=9") == []
    assert versions("map/tile/0/2/*") == [3, 6, 9]
    assert versions("map/tile/0/1/1?since=4") == [5]


def test_the_whole_map_is_made_only_for_who_listens_and_only_when_it_changed(
    open_publisher, open_client, store
):
    grids = 0

    class CountingStore:
        since = staticmethod(store.since)

        def grid(self):
            nonlocal grids
            grids += 1
            return store.grid()

    publisher = open_publisher(map_source=CountingStore(), picture_period_s=0.05)
    client = open_client(publisher.endpoints[0])

    def change(version: int) -> None:
        store.update([tile(0, 0, version)])
        publisher.map_changed([tile(0, 0, version)], 1, 2)

    change(1)
    for number in (1, 2):  # when the second is out, what the map asked for before has been looked at
        publisher.put(message("health", number))
        wait_until(lambda number=number: publisher.counts()["sent"]["health"] == number)
    assert grids == 0
    inbox = Inbox()
    subscriber = subscribe(client, publisher, "map", inbox)
    (first,) = inbox.wait_for(1)  # without a change: who comes first must not wait for one
    assert attachment_of(first).sequence == 1
    assert decode_grid(first.payload.to_bytes()).cells.shape == (8, 8)
    change(2)
    assert attachment_of(inbox.wait_for(2)[1]).sequence == 2
    made = grids
    subscriber.undeclare()
    get(client, "pose")
    change(3)
    (answer,) = get(client, "map")
    assert attachment_of(answer).sequence == 3
    assert grids == made + 1  # for the answer
    publisher.close()  # looks at all that waits
    assert grids == made + 1
    assert publisher.counts()["sent"]["map"] == 2


def test_map_meta_lists_every_tile_with_its_version(publisher, client, store):
    store.update([tile(0, -1, 1), tile(4, 0, 2), tile(0, 0, 3, level=1)])
    publisher.map_changed([], 1, 2)
    (sample,) = get(client, "map/meta")
    about, tiles = decode_diagnostics(sample.payload.to_bytes())
    assert tiles.values == {"0/0/-1": "1", "0/4/0": "2", "1/0/0": "3"}
    assert (about.values["version"], about.values["tiles"], about.values["cell_m"]) == ("3", "3", "0.5")
    (of_tile,) = get(client, "map/tile/0/4/0")
    assert about.values["gid"] == attachment_of(of_tile).gid.hex()


def test_a_map_too_large_for_one_picture_is_counted_and_the_rest_goes_on(publisher, client, store, caplog):
    inbox = Inbox()
    subscribe(client, publisher, "**", inbox)
    far = [tile(0, 0, 1), tile(20_000, 20_000, 2)]
    store.update(far)
    publisher.map_changed(far, 1, 2)
    wait_until(lambda: publisher.counts()["failed"]["map"] == 1)
    publisher.put(message("health", 1, payload=b"health"))
    expected = {"map/tile/0/0/0", "map/tile/0/20000/20000", "map/meta", "health"}  # a meta may come twice
    wait_until(lambda: {str(s.key_expr).removeprefix(f"{ROOT}/") for s in list(inbox.samples)} == expected)
    (reply,) = client.get(f"{ROOT}/map", timeout=TIMEOUT_S)
    assert "cannot be answered now" in reply.err.payload.to_string()
    assert [r.levelname for r in caplog.records if "zenoh map" in r.message] == ["ERROR"]


def test_liveliness_tokens_stand_while_a_component_works(publisher, client):
    inbox = Inbox()
    client.liveliness().declare_subscriber(f"{ROOT}/alive/**", inbox, history=True)
    publisher.set_alive("front")
    publisher.set_alive("front")
    publisher.set_alive("mapper")
    inbox.wait_for(2)
    publisher.set_alive("front", False)
    publisher.set_alive("front", False)
    inbox.wait_for(3)
    publisher.close()
    seen = [(str(s.key_expr).rpartition("/")[2], s.kind == zenoh.SampleKind.PUT) for s in inbox.wait_for(4)]
    assert sorted(seen[:2]) == [("front", True), ("mapper", True)]
    assert seen[2:] == [("front", False), ("mapper", False)]
    publisher.set_alive("front")  # too late, and no harm


def test_a_taken_port_is_refused_with_who_has_it(publisher, open_publisher):
    with pytest.raises(StorageError) as caught:
        open_publisher(PublishingConfig(listen=(publisher.endpoints[0],)))
    assert publisher.endpoints[0] in str(caught.value)
    assert f"(process {os.getpid()})" in str(caught.value)
    assert "change publishing.listen" in str(caught.value)


def test_an_address_of_another_machine_is_refused_in_words(open_publisher):
    with pytest.raises(StorageError, match=r"192\.0\.2\.1:7447: this machine has no such address"):
        open_publisher(PublishingConfig(listen=("tcp/192.0.2.1:7447",), security="none"))


def test_the_port_is_free_and_the_threads_are_gone_after_close(open_publisher, open_client):
    before = set(threading.enumerate())
    publisher = open_publisher()
    publisher.put(message("pose", 1))
    publisher.close()
    publisher.close()
    again = open_publisher(PublishingConfig(listen=(publisher.endpoints[0],)))
    inbox = Inbox()
    client = open_client(again.endpoints[0])
    subscribe(client, again, "pose", inbox)
    again.put(message("pose", 1))
    inbox.wait_for(1)
    client.close()
    again.close()
    for thread in set(threading.enumerate()) - before:
        thread.join(TIMEOUT_S)
        assert not thread.is_alive()


def test_what_was_put_before_the_close_is_sent(publisher, client):
    """On a channel whose messages share a packet: a pose has its own, and Zenoh drops what a starved machine
    does not take within a millisecond.
    """
    inbox = Inbox()
    subscribe(client, publisher, "front/status", inbox)
    for number in range(50):
        publisher.put(message("front/status", number))
    publisher.close()
    assert [attachment_of(s).sequence for s in inbox.wait_for(50)] == list(range(1, 51))


def test_a_router_that_is_not_there_is_not_waited_for_and_found_when_it_comes(open_publisher, open_client):
    site = open_publisher()
    endpoint = site.endpoints[0]
    site.close()
    began_s = time.monotonic()
    vehicle = open_publisher(PublishingConfig(listen=("tcp/127.0.0.1:0",), connect=(endpoint,)))
    vehicle.put(message("pose", 1))
    wait_until(lambda: vehicle.counts()["sent"]["pose"] == 1)
    assert time.monotonic() - began_s < TIMEOUT_S / 2
    site = open_publisher(PublishingConfig(listen=(endpoint,)))
    client = open_client(site.endpoints[0])
    wait_until(lambda: get(client, "pose"))
    site.close()
    vehicle.put(message("pose", 2))  # the site is gone again
    wait_until(lambda: vehicle.counts()["sent"]["pose"] == 2)


LEFT_OPEN = """
import atexit

from service.mapstore.tiles import TileStore
from service.publishing.commands import Answer
from service.publishing.ros2_topics import Ros2Topics
from service.publishing.shared import SharedZenoh
from service.publishing.zenoh_publisher import ZenohPublisher
from tests.service.publishing.test_ros2_topics import config

shared, store = SharedZenoh(), TileStore()
atexit.register(lambda: print("closed:", shared._session.is_closed()))  # after what is registered later
for sink in (ZenohPublisher(config(), "veh1", store, shared=shared), Ros2Topics(config(), shared, store)):
    answer = getattr(sink, "answer_commands", None) or (lambda command: sink.answer(command, None))
    answer(lambda verb, payload: Answer(True, b"{}"))
raise SystemExit(3)
"""


def test_a_process_that_closes_nothing_ends_with_its_session_closed():
    done = subprocess.run([sys.executable, "-c", LEFT_OPEN], timeout=60.0, capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (3, b"closed: True\n", b"")


STALLED = """
import sys, zenoh
from tests.service.publishing.conftest import client_config
session = zenoh.open(client_config(sys.argv[1]))
subscriber = session.declare_subscriber("corridor/**", lambda sample: None)
list(session.get("corridor/v1/veh1/pose"))
print("ready", flush=True)
sys.stdin.read()
"""


def test_a_stalled_subscriber_takes_nothing_from_the_others(publisher, client):
    """It is stopped with full buffers; scans for it are dropped, poses for the others come in time."""
    inbox = Inbox()
    subscribe(client, publisher, "pose", inbox)
    scan = bytes(200_000)
    command = [sys.executable, "-c", STALLED, publisher.endpoints[0]]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as stalled:
        assert stalled.stdout.readline() == "ready\n"
        stalled.send_signal(signal.SIGSTOP)
        pause = threading.Event()
        try:
            for number in range(100):
                publisher.put(message("front/scan", number, payload=scan))
                publisher.put(message("pose", number))
                pause.wait(0.01)
            arrived = inbox.wait_for(100)
        finally:
            stalled.kill()  # the block waits for its end, and one that is stopped ends by itself never
    assert [attachment_of(s).sequence for s in arrived] == list(range(1, 101))
    assert publisher.counts()["dropped"] == {}
