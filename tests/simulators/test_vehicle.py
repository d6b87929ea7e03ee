import socket
from pathlib import Path

import pytest

from service.errors import StorageError
from service.geometry.se2 import SE2
from simulators.device import Beams
from simulators.device_kind import LaserOptions
from simulators.sick_lms100 import FakeLms100
from simulators.trajectory import Follow, plan_drive
from simulators.truth import LMS100, LaserTruth, Ride, seed_of
from simulators.vehicle import FakeVehicle, parse_device, parse_devices, warm_up
from simulators.world import Plan, World, make_world

SUBSCRIBE = b"\x02sEN LMDscandata 1\x03"


@pytest.fixture(scope="module")
def world() -> World:
    plan = Plan()
    plan.line((-5, -5), (5, -5), (5, 5), (-5, 5), (-5, -5))
    return make_world("room", plan, [], plan_drive(SE2(), [Follow([(3, 0)])]))


MOUNTED = ("sick_lms100", "hokuyo_utm30lx", "ibeo_lux", "xsens_mtig")


@pytest.mark.parametrize(
    ("text", "diagnostic"),
    [
        ("sick_lms100", "expected NAME=TYPE"),
        ("front=sick", "TYPE one of sick_lms100, hokuyo_utm30lx, irobot_create"),
        ("front=sick_lms100:colour=red", "colour: .*; sick_lms100 takes x_m, .*host, port, .*model"),
        ("front=sick_lms100:port=high", "port: .*integer"),
        *((f"front={kind}:x_m=50.1", "x_m: .*less than or equal to 50") for kind in MOUNTED),
        *((f"front={kind}:yaw_deg=-361", "yaw_deg: .*greater than or equal to -360") for kind in MOUNTED),
        *((f"front={kind}:y_m=nan", "y_m: ") for kind in MOUNTED),
        ("front=sick_lms100:bias_m=inf", "bias_m: .*finite"),
        ("base=irobot_create:slips_per_m=inf", "slips_per_m: .*finite"),
        ("front=sick_lms100:port", "'port' is not a new key=value"),
        ("front=sick_lms100:port=1,port=2", "'port=2' is not a new key=value"),
    ],
)
def test_wrong_device_is_refused_with_what_is_wrong(text: str, diagnostic: str):
    with pytest.raises(ValueError, match=diagnostic):
        parse_device(text)


@pytest.mark.parametrize("option", ["port", "link"])
def test_a_port_in_use_is_reported_with_its_device(option: str, world: World, tmp_path: Path):
    (tmp_path / "mine").write_text("my own")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        texts = {
            "port": f"front=sick_lms100:port={port}",
            "link": f"front=irobot_create:link={tmp_path}/mine",
        }
        vehicle = FakeVehicle([parse_device(texts[option])], Ride(world, 0), seed=1)
        reasons = {"port": f"Address already in use.*{port}", "link": "File exists"}
        with pytest.raises(StorageError, match=f"^front: no wire: {reasons[option]}"), vehicle:
            pass
    assert (tmp_path / "mine").read_text() == "my own"


def test_two_devices_of_one_name_are_refused():
    with pytest.raises(ValueError, match="two devices are called 'a'"):
        parse_devices(["a=sick_lms100", "a=irobot_create"])


def test_vehicle_reports_the_endpoints_of_its_devices(world: World, tmp_path: Path):
    warm_up(world)
    specs = parse_devices(["front=sick_lms100", f"base=irobot_create:link={tmp_path / 'create'}"])
    with FakeVehicle(specs, Ride(world, 0), seed=1) as vehicle:
        front, base = vehicle.endpoints()
        port = vehicle.wires["front"].endpoint[1]
        assert front == {"name": "front", "device": "sick_lms100", "endpoint": f"tcp://127.0.0.1:{port}"}
        assert base == {"name": "base", "device": "irobot_create", "endpoint": str(tmp_path / "create")}
        assert (tmp_path / "create").is_char_device()
        assert vehicle.failed == []
    assert not (tmp_path / "create").is_symlink()


def test_a_hokuyo_is_on_the_wire_it_was_given(world: World, tmp_path: Path):
    specs = parse_devices([f"rear=hokuyo_utm30lx:link={tmp_path / 'usb'}", "ew=hokuyo_utm30lx:wire=ethernet"])
    with FakeVehicle(specs, Ride(world, 0), seed=1) as vehicle:
        usb, ethernet = vehicle.endpoints()
        assert usb["endpoint"] == str(tmp_path / "usb")
        assert (tmp_path / "usb").is_char_device()
        host, port = vehicle.wires["ew"].endpoint
        assert ethernet["endpoint"] == f"tcp://{host}:{port}"


def telegrams(world: World, seed: int, looks_s: list[float]) -> bytes:
    """Bytes of a laser, fetched at these virtual times."""
    source = LaserTruth(Ride(world, 0, stand_s=0.0), "front", SE2(0.2, 0.0, 0.0), LMS100, seed)
    device = FakeLms100(source, seed=seed_of(seed, "front"))
    sent = device.connected(0) + device.receive_data(SUBSCRIBE, 10)
    for look_s in looks_s:
        now_ns = round(look_s * 1e9)
        while (due_ns := device.next_due_ns(now_ns)) is not None and due_ns <= now_ns:
            sent += device.due(now_ns)
    return sent


def test_same_seed_gives_the_same_bytes_whenever_they_are_fetched(world: World):
    often, seldom = [k * 0.001 for k in range(1000)], [k * 0.1 for k in range(10)]
    assert telegrams(world, 1, often) == telegrams(world, 1, [*seldom, often[-1]])
    assert telegrams(world, 2, often) != telegrams(world, 1, often)


def test_laser_has_the_mounting_and_the_errors_of_its_options(world: World):
    both = LaserOptions(x_m=0.0), LaserOptions(x_m=1.0, yaw_deg=180.0, bias_m=0.1)
    sources = [options.source(Ride(world, 0), "front", LMS100, 1) for options in both]
    ahead, behind = (source.sweep(Beams(0, 27_778, 0.0, 0.0, 50)).range_m.mean() for source in sources)
    assert ahead == pytest.approx(5.0, abs=0.01)
    assert behind == pytest.approx(6.1, abs=0.01)


@pytest.mark.parametrize(
    ("text", "attribute", "value"),
    [
        ("sick_lms100:refuses=LMPoutputRange", "refused", {"LMPoutputRange"}),
        ("sick_lms100:firmware=V1.23", "firmware", "V1.23"),
        ("sick_lms100", "refused", set()),
        ("hokuyo_utm30lx:refuses=ME", "refused", {"ME"}),
        ("ibeo_lux:refuses=SCAN_FREQUENCY", "fixed", {0x1102}),
        ("ibeo_lux", "fixed", set()),
        ("xsens_mtig:product=MTi-30-2A5G4", "product", "MTi-30-2A5G4"),
    ],
)
def test_device_refuses_what_its_options_name(world: World, text: str, attribute: str, value: object):
    (device,) = FakeVehicle(parse_devices([f"x={text}"]), Ride(world, 0), 1).devices.values()
    assert getattr(device.setup, attribute) == value
