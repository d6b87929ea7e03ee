"""A vehicle that was without a link for long: what it did comes in order, a page at a time."""

import json

import pytest

from service.encoding import OK, Status, encode_diagnostics, encode_pose
from service.fleet.pull import JOURNAL_FILE, pull
from service.fleet.queries import RefusedError, ask
from service.sinks.fleet_files import JOURNAL
from service.sinks.fleet_journal import PAGE_LINES, PERIOD_NS, FleetJournal
from tests.service.fleet.conftest import is_in_fleet
from tests.service.test_encoding_outputs import OUTPUT
from tests.waiting import wait_until

BEGIN_NS = 1_700_000_000_000_000_000


def health(log_ns: int, state: str = "ok"):
    return encode_diagnostics("diagnostics", [Status("mapping", OK, state, {"state": state})], log_ns, log_ns)


def drive(note, lines: int, first: int = 0) -> None:
    for number in range(first, first + lines):
        note(health(BEGIN_NS + number * PERIOD_NS))


def lines_of(path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_day_without_a_router_comes_in_order_and_a_page_at_a_time(
    endpoint, start_router, start_vehicle, open_client, tmp_path
):
    sink = start_vehicle(endpoint, waits=False, folders={"recording": tmp_path})
    sink.put(encode_pose(OUTPUT, BEGIN_NS))
    day = 86_400 * 10**9 // PERIOD_NS
    drive(sink.put, day)
    start_router(endpoint)
    wait_until(lambda: is_in_fleet(sink))
    client = open_client(endpoint)
    wait_until(lambda: ask(client, "veh1", f"{JOURNAL}?after=0"))
    assert ask(client, "veh1", f"{JOURNAL}?after=0").count(b"\n") == PAGE_LINES
    assert pull(client, "veh1", tmp_path / "out").journal_lines == day
    lines = lines_of(tmp_path / "out/veh1" / JOURNAL_FILE)
    assert [line["unix_ns"] for line in lines] == [BEGIN_NS + k * PERIOD_NS for k in range(day)]
    assert lines[0]["x_m"] == pytest.approx(OUTPUT.pose_map_base.x_m, abs=1e-3)


def test_what_was_fetched_is_not_fetched_again_and_a_torn_line_is(endpoint, start_vehicle, client, tmp_path):
    journal = FleetJournal(tmp_path / "fleet.sqlite")
    drive(journal.health, 3)
    journal.write()
    start_vehicle(endpoint, folders={"recording": tmp_path})
    assert pull(client, "veh1", tmp_path / "out").journal_lines == 3
    path = tmp_path / "out/veh1" / JOURNAL_FILE
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    assert pull(client, "veh1", tmp_path / "out").journal_lines == 1
    assert path.read_bytes() == whole
    assert pull(client, "veh1", tmp_path / "out").journal_lines == 0


def test_a_line_is_noted_each_period_and_with_each_change_of_the_state(tmp_path):
    journal = FleetJournal(tmp_path / "fleet.sqlite")
    for second in range(25):
        journal.health(health(BEGIN_NS + second * 10**9, "lost" if second == 13 else "ok"))
    journal.write()
    lines = [json.loads(line) for line in journal.page(0).splitlines()]
    at_s = [(line["unix_ns"] - BEGIN_NS) // 10**9 for line in lines]
    assert list(zip(at_s, (line["state"] for line in lines), strict=True)) == [
        (0, "ok"),
        (10, "ok"),
        (13, "lost"),
        (14, "ok"),
        (24, "ok"),
    ]


def test_a_clock_that_is_set_back_keeps_the_order(tmp_path):
    journal = FleetJournal(tmp_path / "fleet.sqlite")
    for offset_s in (100, 0):
        journal.health(health(BEGIN_NS + offset_s * 10**9))
    journal.write()
    assert [json.loads(line)["unix_ns"] - BEGIN_NS for line in journal.page(0).splitlines()] == [
        100 * 10**9,
        100 * 10**9 + 1,
    ]


def test_a_journal_that_is_damaged_is_refused_and_the_link_stays(endpoint, start_vehicle, client, tmp_path):
    (tmp_path / "fleet.sqlite").write_bytes(b"no database" * 1000)
    sink = start_vehicle(endpoint, folders={"recording": tmp_path})
    with pytest.raises(RefusedError, match="not a database"):
        ask(client, "veh1", f"{JOURNAL}?after=0")
    drive(sink.put, 1)
    wait_until(lambda: "not a database" in sink.health().message)
    assert is_in_fleet(sink)
