import math
import re
from pathlib import Path

import pytest

from drivers.irobot_create.config import IrobotCreateConfig
from drivers.sick_lms100.config import Lms100Config
from service.config import (
    laser_names,
    load_config,
    load_publishing,
    load_replay_config,
    mapped_lasers,
    mounted_upside_down,
    mountings,
    parse_config,
    parse_replay_config,
    tf_static,
)
from service.encoding import decode_transforms
from service.errors import ConfigError
from service.sensor_kinds import SENSOR_KINDS

ROOT = Path(__file__).parents[2]
GOOD = """\
vehicle: veh1
sensors:
  front: {type: sick_lms100, host: 192.168.0.1, mounting: {x_m: 0.2, yaw_deg: 90.0}}
  base:
    type: irobot_create
    device: /dev/ttyUSB0
recording: {directory: sessions}
map: {directory: maps}
"""


def faults(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "c.yaml")
    return caught.value.faults


def with_line(line: str, number: int) -> str:
    lines = GOOD.splitlines(keepends=True)
    return "".join([*lines[: number - 1], line + "\n", *lines[number:]])


def test_a_good_config_is_read_with_its_defaults():
    config = parse_config(GOOD, "c.yaml")
    assert config.vehicle == "veh1"
    assert isinstance(config.sensors["front"], Lms100Config)
    assert isinstance(config.sensors["base"], IrobotCreateConfig)
    assert config.sensors["front"].name == "front"
    assert config.sinks["recording"].directory == Path("sessions")
    assert config.sinks["recording"].rotate_mb == 1024
    assert config.sinks["publishing"].listen == ("tcp/127.0.0.1:7447",)
    assert config.mapping.profile == "corridor"
    assert config.text == GOOD


def test_an_antenna_lies_where_mounting_axes_and_lever_arm_put_it():
    """The unit's y axis looks to the left of the vehicle, and the antenna lies 0.5 m along it."""
    imu = (
        "  imu: {type: xsens_mtig, device: /dev/x, forward_axis: y, lever_arm_m: [0.2, 0.5, 1.0], "
        "mounting: {x_m: 1.0, y_m: 0.0, yaw_deg: 90.0}}"
    )
    lines = GOOD.splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("sensors:")) + 1
    poses = mountings(parse_config("\n".join([*lines[:at], imu, *lines[at:]]), "c.yaml").sensors)
    # Forward of the unit is its y, left its -x; the unit looks left, so both turn by 90 degrees.
    assert (poses["imu/antenna"].x_m, poses["imu/antenna"].y_m) == pytest.approx((1.0 + 0.2, 0.5))
    assert poses["imu"].x_m == 1.0
    over = imu.replace("x_m: 1.0", "upside_down: true, z_m: 2.0, x_m: 1.0")
    sensors = parse_config("\n".join([*lines[:at], over, *lines[at:]]), "c.yaml").sensors
    assert sensors["imu"].antenna_m == pytest.approx((1.0 - 0.2, 0.5, 2.0 - 1.0))


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (with_line("vehicle: Veh 1", 1), 'c.yaml:1:1: vehicle: "Veh 1" becomes part of Zenoh keys'),
        (with_line("vehicle: 12", 1), 'c.yaml:1:1: vehicle: a name is text; write vehicle: "12", or veh12'),
        (with_line("vehicle: a__b", 1), "a_b would do"),
        (with_line(f"vehicle: {'v' * 33}", 1), "at most 32"),
        (with_line("# none", 1), 'c.yaml:2:1: "vehicle" is missing; write vehicle: veh1, say'),
        (with_line("  map: {type: sick_lms100, host: a}", 3), "c.yaml:3:3: sensors.map: reserved"),
        (with_line("  a/b: {type: sick_lms100, host: a}", 3), "c.yaml:3:3: sensors.a/b: "),
        (
            with_line("  front: {type: sick_lms10, host: a}", 3),
            "c.yaml:3:11: sensors.front.type: 'sick_lms10' is no type of sensor; did you mean",
        ),
        (with_line("  front: {host: a}", 3), 'c.yaml:3:3: sensors.front: "type" is missing; known here: '),
        (with_line("  front:", 3), "c.yaml:3:3: sensors.front: a sensor is a mapping"),
        (
            with_line("  front: {type: sick_lms100, name: front, host: a}", 3),
            "c.yaml:3:30: sensors.front.name: the key is the name already (front)",
        ),
        (
            with_line("  front: {type: sick_lms100}", 3),
            "c.yaml:3:3: sensors.front.host: missing, and there is no sensible default",
        ),
        (
            with_line("  front: {type: sick_lms100, hots: a, host: a}", 3),
            'c.yaml:3:30: sensors.front.hots: unknown key; did you mean "host"?',
        ),
        (
            with_line("  front: {type: sick_lms100, host: a, silence_timeout_ms: 250}", 3),
            "c.yaml:3:39: sensors.front.silence_timeout_ms: unknown key; "
            'this setting is "silence_timeout_s", in seconds; write silence_timeout_s: 0.25',
        ),
        (
            with_line("  front: {type: sick_lms100, host: a, mounting: {yaw: 90}}", 3),
            'c.yaml:3:50: sensors.front.mounting.yaw: unknown key; this setting is "yaw_deg", in degrees',
        ),
        (
            with_line('  front: {type: sick_lms100, host: a, port: "2111"}', 3),
            'c.yaml:3:39: sensors.front.port: should be a valid integer (got "2111"); '
            "write 2111 without quotes",
        ),
        (
            with_line("  front: {type: sick_lms100, host: a, port: true}", 3),
            "c.yaml:3:39: sensors.front.port: should be a valid integer (got true); write a number",
        ),
        (
            with_line("web: {listen: 8080}", 9),
            'c.yaml:9:7: web.listen: should be a valid string (got 8080); write "127.0.0.1:8080", say',
        ),
        (
            with_line("web: {enabled: 1}", 9),
            "c.yaml:9:7: web.enabled: should be a valid boolean (got 1); write true or false",
        ),
        (
            with_line("  front: {type: sick_lms100, host: 5}", 3),
            'sensors.front.host: should be a valid string (got 5); write it in quotes: "5"',
        ),
        (with_line("\tfront: {type: sick_lms100, host: a}", 3), "write spaces in place of the tab"),
        (
            with_line("  front: {type: sick_lms100, host: a, scan_rate_hz: 40}", 3),
            "c.yaml:3:39: sensors.front.scan_rate_hz: should be 15, 25, 35, 50, 75 or 100 (got 40)",
        ),
        (
            with_line("  front: {type: sick_lms100, host: a, angle_step_deg: 0.25}", 3),
            "c.yaml:3:3: sensors.front: front: angle_step_deg 0.25 needs scan_rate_hz 25 or less, not 50",
        ),
        (
            with_line("recording: {directory: s, rotate_gb: 1}", 7),
            'rotate_gb: unknown key; this setting is "rotate_mb", in megabytes; write rotate_mb: 1000',
        ),
        (
            with_line("recording: {directory: s, rotate_s: 90}", 7),
            'rotate_s: unknown key; this setting is "rotate_min", in minutes; write rotate_min: 1.5',
        ),
        (
            with_line("recording: {directory: s, rotate_s: a}", 7),
            'rotate_s: unknown key; this setting is "rotate_min", in minutes',
        ),
        (
            with_line("recording: {directory: s, rotate: 90}", 7),
            'this setting is "rotate_mb", in megabytes or "rotate_min", in minutes',
        ),
        (
            with_line("recording: {directory: s, keep_free_gb: -1}", 7),
            "recording.keep_free_gb: should be greater than or equal to 0 (got -1)",
        ),
        (with_line("  front: {type: sick_lms100, host: 192.168.0. 1}", 3), "sensors.front.host: neither"),
        (with_line("  front: {type: [a], host: b}", 3), "sensors.front.type: ['a'] is no type of"),
        (with_line('recording: {directory: ""}', 7), "c.yaml:7:13: recording.directory: an empty path"),
        (with_line("map: {directory: ~/maps}", 8), "c.yaml:8:7: map.directory: ~ is not expanded"),
        (with_line("recording: {directory: s, rotate_mb: 0x1_0}", 7), 'write 16, or quote it: "0x1_0"'),
        (
            with_line(f"recording: {{directory: s, rotate_mb: {'9' * 30}}}", 7),
            f"recording.rotate_mb: {'9' * 30} is beyond 64 bits",
        ),
        (with_line("recording: []", 7), "c.yaml:7:1: recording: this is a mapping with the keys directory, "),
        (with_line("recroding: {}", 7), 'c.yaml:7:1: recroding: unknown key; did you mean "recording"'),
        (with_line("map: {directory: no}", 8), "c.yaml:8:18: map.directory: YAML takes no for false"),
        (GOOD + "publishing: {listen: [7447]}\n", "c.yaml:9:23: publishing.listen.0: should be a valid"),
        (GOOD + "mapping: {settings: {matcher: {cauchy_n: 3}}}\n", 'did you mean "cauchy_m"?'),
        (
            GOOD + "mapping: {mode: localization}\n",
            "c.yaml:9:11: mapping.mode: localization is in a stored map; name its folder in map: {load",
        ),
        (GOOD + "page: {listen: 127.0.0.1:8080}\n", "c.yaml:9:1: page: unknown key; known here: vehicle, "),
        ("- a\n", "c.yaml:1:1: a config is a mapping with the keys vehicle, sensors, "),
        ("", "c.yaml:1:1: a config is a mapping with the keys vehicle, sensors, "),
    ],
)
def test_a_fault_says_where_it_is_and_what_to_write(text: str, fault: str):
    assert any(fault in found for found in faults(text)), faults(text)


def test_all_faults_come_at_once_and_in_order_of_place():
    text = with_line("  front: {type: sick_lms100, hots: a, port: x}", 3) + "mapping: {cell_cm: 5}\n"
    found = faults(text)
    assert [line.split(": ")[1] for line in found] == [
        "sensors.front.host",
        "sensors.front.hots",
        "sensors.front.port",
        "mapping.cell_cm",
    ]


def test_every_laser_is_mapped_unless_it_says_no():
    text = with_line("  imu: {type: xsens_mtig, device: /dev/i}\n  lux: {type: ibeo_lux, host: b}\n"
                     "  rear: {type: hokuyo_utm30lx, host: c}", 3)  # fmt: skip
    config = parse_config(text, "c.yaml")
    assert laser_names(config.sensors) == ["lux", "rear"]
    assert mapped_lasers(config) == ("lux", "rear")
    without = text.replace("host: b}", "host: b, map: false}")
    assert mapped_lasers(parse_config(without, "c.yaml")) == ("rear",)
    assert mapped_lasers(parse_config(with_line("", 3), "c.yaml")) == ()


def test_a_sensor_upside_down_and_its_height_stand_in_its_mounting():
    text = with_line("  front: {type: sick_lms100, host: a, mounting: {x_m: 0.2, z_m: 0.3, yaw_deg: 30.0, "
                     "upside_down: true}}", 3)  # fmt: skip
    sensors = parse_config(text, "c.yaml").sensors
    assert mounted_upside_down(sensors) == {"front"}
    pose = mountings(sensors)["front"]
    assert (pose.x_m, math.degrees(pose.theta_rad)) == (0.2, pytest.approx(30.0))
    (edge,) = decode_transforms(tf_static(sensors, 0).payload)
    assert edge.translation_m == (0.2, 0.0, 0.3)


@pytest.mark.parametrize(
    ("front", "paths"),
    [
        ("type: sick_lms10, hots: a, mounting: {yaw: 1}", ["type", "host", "hots", "mounting.yaw"]),
        ("type: roof, host: a b, mounting: {yaw: 1}", ["type", "host", "mounting.yaw"]),
        ("host: a, dialect: third, scan_rate_hz: 50", ["", "dialect"]),
        ("type: sick_lms100, name: it, port: x", ["name", "port", "host"]),
    ],
)
def test_a_wrong_type_hides_no_other_fault(front: str, paths: list[str]):
    """What the type spelt alike refuses, or what all types refuse that take most of the keys."""
    found = [fault.split(": ")[1] for fault in faults(with_line(f"  front: {{{front}}}", 3))]
    assert sorted(found) == sorted(".".join(["sensors.front", path]).rstrip(".") for path in paths)


def test_two_sensors_on_one_wire_are_refused():
    text = with_line("  front: {type: sick_lms100, host: a}\n  rear: {type: sick_lms100, host: a}", 3)
    assert faults(text) == [
        "c.yaml:4:29: sensors.rear.host: a:2111 is taken by front; two sensors cannot share a wire"
    ]


@pytest.mark.parametrize(
    ("zenoh", "page", "port"),
    [
        ("tcp/127.0.0.1:7001", "127.0.0.1:7001", 7001),
        ("ws/localhost:9000", "0.0.0.0:9000", 9000),
        ("tcp/[::]:9000", "127.0.0.1:9000", 9000),
        ("tcp/[::1]:9000", "[::]:9000", 9000),
        ("tcp/[::1]:9000", "0.0.0.0:9000", None),
        ("tcp/127.0.0.1:9000", "[::]:9000", None),  # the page is at IPv6 alone then
        ("tcp/127.0.0.1:0", "127.0.0.1:0", None),
        ("tcp/127.0.0.1:8080", "127.0.0.2:8080", None),
        ("udp/127.0.0.1:8080", "127.0.0.1:8080", None),
    ],
)
def test_the_page_and_zenoh_have_ports_of_their_own(zenoh: str, page: str, port: int | None):
    text = f"{GOOD}publishing: {{listen: ['{zenoh}'], security: none}}\nweb: {{listen: '{page}'}}\n"
    if port is None:
        assert parse_config(text, "c.yaml").sinks["web"].listen == page
    else:
        expected = f"web.listen: port {port} is taken by publishing.listen; give each a port of its own"
        assert [fault.partition(": ")[2] for fault in faults(text)] == [expected]
        assert parse_config(text.replace("web: {", "web: {enabled: false, "), "c.yaml")


def test_a_router_listens_at_each_port_once(tmp_path: Path):
    (path := tmp_path / "router.yaml").write_text(
        "publishing: {listen: ['tcp/127.0.0.1:7447', 'tcp/127.0.0.1:7447']}"
    )
    with pytest.raises(ConfigError, match=r"publishing\.listen: port 7447 is taken by publishing\.listen"):
        load_publishing(path)


@pytest.mark.parametrize(
    ("one", "other"), [("LMS.local", "lms.local."), ("fe80::0:1", "fe80::1"), ("10.0.0.7", "::ffff:10.0.0.7")]
)
def test_two_spellings_of_a_host_are_one_wire(one: str, other: str):
    front, rear = (f"  {name}: {{type: sick_lms100, host: '{host}'}}" for name, host in
                   (("front", one), ("rear", other)))  # fmt: skip
    (fault,) = faults(with_line(f"{front}\n{rear}", 3))
    assert fault.endswith(
        f"sensors.rear.host: {other}:2111 is taken by front; two sensors cannot share a wire"
    )


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff\xfe\x00", ":1:1: byte 0xff is not UTF-8; save the file as UTF-8"),
        ("vehicle: v\r\n# grün, ".encode() + "grün".encode("latin-1"), ":2:11: byte 0xfc is not UTF-8; save"),
        ("# grü".encode()[:-1], ":1:5: byte 0xc3 is not UTF-8; save"),
    ],
)
def test_a_file_in_another_encoding_is_refused_where_it_shows(tmp_path: Path, content: bytes, words: str):
    path = tmp_path / "c.yaml"
    path.write_bytes(content)
    for load in (load_config, load_replay_config):
        with pytest.raises(ConfigError, match=re.escape(f"{path}{words}")):
            load(path)


def test_the_complete_example_is_right_and_shows_every_section():
    config = load_config(ROOT / "config" / "vehicle.yaml")
    for section in ("vehicle", "sensors", "mapping", "publishing", "recording", "map", "web"):
        assert f"\n{section}:" in config.text
    for model in config.sinks.values():
        for key in type(model).model_fields:
            assert f"  {key}:" in config.text


def test_a_replay_needs_no_more_than_sensors_and_mapping(tmp_path: Path):
    config = tmp_path / "c.yaml"
    config.write_text(
        "sensors:\n  front: {type: sick_lms100, mounting: {x_m: 0.2}}\n  base: {type: irobot_create}\n"
        "  rear: {type: hokuyo_utm30lx, map: false}\n"
    )
    read = load_replay_config(config)
    assert (mapped_lasers(read), mountings(read.sensors)["front"].x_m) == (("front",), 0.2)
    config.write_text("mapping: {profile: imle}\nrecording: {rotate_mb: x}\nmap: {directory: {}}\n")
    assert load_replay_config(config).mapping.profile == "imle"
    assert load_replay_config(config).begin_in is None
    config.write_text("map: {load: maps/office}\n")
    assert load_replay_config(config).begin_in == Path("maps/office")
    with pytest.raises(ConfigError, match=r"c\.yaml:1:2: recroding: unknown key"):
        parse_replay_config("{recroding: {}}", "c.yaml")
    with pytest.raises(ConfigError, match=r"sensors\.front\.mounting\.x: unknown key"):
        parse_replay_config("sensors: {front: {type: ibeo_lux, mounting: {x: 1}}}", "c.yaml")


def test_what_the_complete_example_leaves_out_is_right_too():
    text = (ROOT / "config" / "vehicle.yaml").read_text()
    whole = parse_config(re.sub(r"(?m)^  # (?=rear:|lux:|imu:|  \w+: )", "  ", text), "vehicle.yaml")
    assert len({sensor.type for sensor in whole.sensors.values()}) == 5  # others have their own examples
    assert mapped_lasers(whole) == ("front", "rear", "lux")


@pytest.mark.parametrize("kind", sorted(SENSOR_KINDS))
def test_the_example_of_each_sensor_is_right(kind: str):
    example = (ROOT / "config" / "sensors" / f"{kind}.yaml").read_text()
    indented = "".join(f"    {line}\n" for line in example.splitlines())
    text = f"vehicle: v\nsensors:\n  it:\n{indented}recording: {{directory: s}}\nmap: {{directory: m}}\n"
    assert parse_config(text, "c.yaml").sensors["it"].type == kind
