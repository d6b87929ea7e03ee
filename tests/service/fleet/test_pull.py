"""Recordings of a vehicle over loopback: whole, in order, and on from where an earlier try ended."""

import json
import os
import threading

import pytest

from service.errors import InputError, StorageError
from service.fleet import pull as pull_module
from service.fleet.pull import JOURNAL_FILE, pull
from service.fleet.vehicles import present
from service.sinks.fleet_files import PART_BYTES
from tests.service.cli.test_commands import code_of
from tests.waiting import wait_until

SIZES = {"veh1_20261121T101500Z_0002.mcap": 10, "veh1_20261121T101500Z_0001.mcap": 2 * PART_BYTES + 7}


@pytest.fixture
def recordings(tmp_path):
    folder = tmp_path / "sessions"
    folder.mkdir()
    for name, size in SIZES.items():
        (folder / name).write_bytes(os.urandom(size))
    (folder / "veh1_20261121T101500Z_0003.mcap.active").write_bytes(b"not finished")
    return folder


@pytest.fixture
def vehicle(endpoint, router, start_vehicle, recordings):
    return start_vehicle(endpoint, folders={"recording": recordings})


def test_finished_recordings_come_whole_and_oldest_first_and_once(vehicle, client, recordings, tmp_path):
    steps: list[tuple[int, int]] = []
    first = pull(client, "veh1", tmp_path / "out", progress=lambda *step: steps.append(step))
    assert first.fetched == tuple(sorted(SIZES))
    assert {path.name for path in (tmp_path / "out/veh1").iterdir()} == {*SIZES, JOURNAL_FILE}
    for name in SIZES:
        assert (tmp_path / "out/veh1" / name).read_bytes() == (recordings / name).read_bytes()
    assert steps[-1] == (sum(SIZES.values()), sum(SIZES.values()))
    again = pull(client, "veh1", tmp_path / "out")
    assert (again.fetched, again.there, again.bytes) == ((), tuple(sorted(SIZES)), 0)


def test_a_file_with_another_checksum_is_an_error_and_removed(vehicle, client, recordings, tmp_path):
    name = min(SIZES)
    part = tmp_path / "out/veh1" / f"{name}.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(b"of another file")
    with pytest.raises(InputError, match="SHA-256"):
        pull(client, "veh1", tmp_path / "out")
    assert not part.exists()
    assert not (part.parent / name).exists()


def test_another_recording_by_the_same_name_is_kept(vehicle, client, recordings, tmp_path, caplog):
    """A vehicle whose clock begins anew at each boot gives a name twice, once its first file is removed."""
    name = min(SIZES)
    archived = tmp_path / "out/veh1" / name
    archived.parent.mkdir(parents=True)
    archived.write_bytes(b"of an earlier day")
    assert name in pull(client, "veh1", tmp_path / "out").fetched
    assert archived.read_bytes() == (recordings / name).read_bytes()
    (kept,) = archived.parent.glob(f"{archived.stem}_of_*.mcap")
    assert kept.read_bytes() == b"of an earlier day"
    assert f"it is kept as {kept.name}" in caplog.text


def test_a_lost_link_delays_a_transfer_and_does_not_end_it(
    endpoint, start_router, start_vehicle, recordings, open_client, tmp_path
):
    router = start_router(endpoint)
    start_vehicle(endpoint, folders={"recording": recordings})
    lost = threading.Event()

    def cut_once(done: int, total: int) -> None:
        if not lost.is_set():
            lost.set()
            router.close()
            start_router(endpoint)

    pulled = pull(open_client(endpoint), "veh1", tmp_path / "out", progress=cut_once, pause_s=0.3)
    assert lost.is_set()
    assert set(pulled.fetched) == set(SIZES)


def test_a_pull_into_a_folder_that_another_one_writes_to_is_refused(vehicle, client, tmp_path):
    """A timer begins one each ten minutes, and the first takes an hour, say."""
    refusals = []

    def pull_too(done: int, total: int) -> None:
        with pytest.raises(StorageError, match=r"another pull writes to .*veh1; wait") as found:
            pull(client, "veh1", tmp_path / "out")
        refusals.append(found.value)

    assert set(pull(client, "veh1", tmp_path / "out", progress=pull_too).fetched) == set(SIZES)
    assert refusals


def test_a_limit_spreads_the_transfer_over_time(vehicle, client, tmp_path, monkeypatch):
    pauses: list[float] = []
    monkeypatch.setattr(pull_module.time, "sleep", pauses.append)
    pull(client, "veh1", tmp_path / "out", limit_bytes_per_s=PART_BYTES)
    assert pauses[0] == pytest.approx(1.0, abs=0.5)
    assert pauses[1] == pytest.approx(2.0, abs=0.5)  # since the begin, for no time passes in this test


def test_viewers_fetch_nothing(endpoint, start_router, start_vehicle, recordings, client_of, tmp_path):
    secured = endpoint.replace("tcp", "tls")
    start_router(secured)
    start_vehicle(secured, folders={"recording": recordings})
    with pytest.raises(StorageError, match="does not answer"):
        pull(client_of(secured, "viewer"), "veh1", tmp_path / "out")
    assert pull(client_of(secured, "operator"), "veh1", tmp_path / "out").fetched


def test_of_two_vehicles_by_one_name_nothing_is_fetched(
    vehicle, endpoint, start_vehicle, site_file, client, tmp_path, capsys
):
    start_vehicle(endpoint, waits=False)
    wait_until(lambda: len(present(client).get("veh1", ())) == 2)
    out = tmp_path / "out"
    assert code_of(["fleet", "pull", "veh1", "--site", site_file, "--out", str(out), "--json"]) == 1
    assert "two vehicles by this name" in json.loads(capsys.readouterr().out)["vehicles"]["veh1"]["error"]
    assert not out.exists()


def test_the_command_says_what_it_fetched_and_asks_a_vehicle_that_is_named_twice_once(
    vehicle, site_file, recordings, tmp_path, capsys
):
    command = ["fleet", "pull", "veh1", "veh1", "--site", site_file, "--out", str(tmp_path / "out"), "--json"]
    assert code_of(command) == 0
    fetched = json.loads(capsys.readouterr().out)["vehicles"]["veh1"]
    assert (fetched["fetched"], fetched["bytes"]) == (sorted(SIZES), sum(SIZES.values()))
    assert code_of([*command[:2], "veh7", *command[4:]]) == 74
    assert not (tmp_path / "out" / "veh7").exists()


@pytest.mark.parametrize("name", ["a//b", "*", "veh1?x", "Veh 1"])
@pytest.mark.parametrize("work", [["pull", "--out", "out"], ["push", "map"], ["status"]])
def test_what_is_no_name_of_a_vehicle_is_wrong_usage(work, name, capsys):
    """Zenoh refuses some as keys, and takes others for all vehicles."""
    assert code_of(["fleet", *work, name]) == 64
    assert "is no name of a vehicle; it takes lower-case letters" in capsys.readouterr().err


def test_a_disk_that_refuses_keeps_no_other_vehicle_back(
    vehicle, endpoint, start_vehicle, recordings, site_file, tmp_path, capsys
):
    start_vehicle(endpoint, "veh2", folders={"recording": recordings})
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "veh1").touch()
    assert code_of(["fleet", "pull", "--site", site_file, "--out", str(tmp_path / "out"), "--json"]) == 74
    report = json.loads(capsys.readouterr().out)["vehicles"]
    assert report["veh1"]["error"].startswith(f"cannot write to {tmp_path / 'out' / 'veh1'}: File exists")
    assert report["veh2"]["fetched"] == sorted(SIZES)
