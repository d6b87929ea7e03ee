"""The configuration of one vehicle: config/*.yaml -> ServiceConfig, or every fault in it at once.

The small models live beside what they configure (drivers/*/config.py, service/mapper, ...); this module joins
them and turns what they refuse into `file:line:column: path: what is wrong, what to write instead`.
"""

import difflib
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel

from drivers.antenna import antenna_of
from drivers.wires import one_spelling
from service.encoding import Message, decode_mountings, decode_upside_down, encode_tf_static
from service.errors import ConfigError
from service.geometry.se2 import SE2
from service.located_model import add_fault, raise_faults, read_file, refuse_large, validated
from service.located_yaml import Document, Fault, load
from service.located_yaml import Path as KeyPath
from service.mapper.profiles import MappingConfig, begins_in_stored, mapping_model
from service.publishing.config import PublishingConfig, Ros2Config
from service.publishing.keys import MAX_NAME_LENGTH, NAME_RULE, is_name
from service.publishing.ros2_names import own_topics
from service.recording.choice import Choice
from service.sensor_kinds import SENSOR_KINDS
from service.sinks.registry import SINKS
from service.suggestion import suggest, unknown_key

if TYPE_CHECKING:  # a live service reads no recording
    from service.recording.mcap_reader import Readable

_ANY_ADDRESS = frozenset(("0.0.0.0", "::"))
# Taken by frames, topics and keys of the service itself.
RESERVED_NAMES = frozenset(
    ("alive", "base_link", "cmd", "diagnostics", "events", "health", "map", "odom", "pose", "tf", "tf_static")
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayConfig:
    """What of a config a replay needs: where sensors sit, and how their scans are mapped."""

    sensors: Mapping[str, Any]  # name -> the config model of its type, see drivers.registry
    mapping: MappingConfig
    replay: Choice  # topics and frames of recordings of others
    begin_in: Path | None  # folder of the stored map that the session begins in; None: a new map


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceConfig(ReplayConfig):
    """All settings of the service. `text` is the YAML itself, which goes into every recording."""

    vehicle: str
    sinks: Mapping[str, Any]  # section -> its config model, see service.sinks.registry
    text: str


AnyConfig = TypeVar("AnyConfig", bound=ReplayConfig)


def mountings(sensors: Mapping[str, Any]) -> dict[str, SE2]:
    """pose_base_sensor of every sensor that has a mounting, by name; rounded as /tf_static rounds it.

    A GNSS antenna whose lever arm is given is "<sensor>/antenna", which no sensor can be called.
    """
    return decode_mountings(tf_static(sensors, 0).payload)


def mounted_upside_down(sensors: Mapping[str, Any]) -> frozenset[str]:
    """Names of those sensors."""
    return decode_upside_down(tf_static(sensors, 0).payload)


def tf_static(sensors: Mapping[str, Any], unix_ns: int) -> Message:
    """base_link -> every sensor that has a mounting, and every GNSS antenna whose lever arm is given."""
    mounted = {name: sensor.mounting for name, sensor in sensors.items() if hasattr(sensor, "mounting")}
    poses = {name: SE2(m.x_m, m.y_m, math.radians(m.yaw_deg)) for name, m in mounted.items()}
    heights_m = {name: m.z_m for name, m in mounted.items()}
    for name, sensor in sensors.items():
        if (antenna_m := getattr(sensor, "antenna_m", None)) is not None:
            poses[antenna_of(name)] = SE2(antenna_m[0], antenna_m[1])
            heights_m[antenna_of(name)] = antenna_m[2]
    upside_down = [name for name, m in mounted.items() if m.upside_down]
    return encode_tf_static(poses, unix_ns, unix_ns, heights_m, upside_down)


def laser_names(sensors: Mapping[str, Any]) -> list[str]:
    """Those of the sensors that give scans, in the order of the config."""
    return [name for name, sensor in sensors.items() if SENSOR_KINDS[sensor.type].laser]


def mapped_lasers(config: ReplayConfig) -> tuple[str, ...]:
    """Whose scans are mapped: every laser's that does not say `map: false`."""
    return tuple(name for name in laser_names(config.sensors) if config.sensors[name].map)


_KEYS = ("vehicle", "sensors", "mapping", "replay", *dict.fromkeys(kind.section for kind in SINKS))


def load_config(path: Path) -> ServiceConfig:
    """Read a config file. Raises ConfigError with every fault, also where the file cannot be read."""
    return parse_config(read_file(path), str(path))


def load_replay_config(path: Path) -> ReplayConfig:
    """Read of a config file what a replay needs: `sensors` without their wires, `mapping` and `replay`. All
    may be left out; the other sections are not looked at. Raises ConfigError as load_config does.
    """
    return parse_replay_config(read_file(path), str(path))


def load_publishing(path: Path) -> PublishingConfig:
    """Read of a config file the section `publishing` alone. Raises ConfigError as load_config does."""
    document = load(read_file(path))
    read = _Reader(document).read_publishing()
    raise_faults(document, str(path))
    assert isinstance(read, PublishingConfig)
    return read


def parse_config(text: str, file: str) -> ServiceConfig:
    """As load_config, for text already at hand; `file` names it in the faults."""
    document = load(text)
    values = _Reader(document).read()
    raise_faults(document, file)
    return ServiceConfig(**values, text=text)


def parse_replay_config(text: str, file: str) -> ReplayConfig:
    """As load_replay_config, for text already at hand."""
    document = load(text)
    values = _Reader(document).read_for_replay()
    raise_faults(document, file)
    return ReplayConfig(**values)


def recorded_config(
    recording: "Readable", parse: Callable[[str, str], AnyConfig], is_replaced: bool = False
) -> AnyConfig | None:
    """The config that a recording holds; None where it holds none.

    parse         parse_config or parse_replay_config
    is_replaced   another one is used: None where this one cannot be read. Else that raises ConfigError
    """
    text = recording.metadata.get("config", {}).get("yaml")
    if text is None:
        return None
    name = f"{recording.paths[0]}, recorded config"
    try:
        refuse_large(text, name)
        return parse(text, name)
    except ConfigError as error:
        if is_replaced:
            return None
        raise ConfigError([*error.faults, "give another config by --config"]) from error


class _Reader:
    """Collects values and faults of one document."""

    def __init__(self, document: Document) -> None:
        self._document = document

    def read(self) -> dict[str, Any]:
        """Every section."""
        if (root := self._root()) is None:
            return {}
        sensors = self._sensors(root.get("sensors"))
        self._refuse_shared_wires(sensors)
        name = self._name((), root.get("vehicle"), "vehicle")
        sinks = {
            kind.section: self._model(kind.load_model(), _section(root, kind.section), (kind.section,))
            for kind in SINKS
        }
        if isinstance(sinks["publishing"], PublishingConfig):
            self._refuse_own_topics(sensors, sinks["publishing"].ros2)
        self._refuse_shared_ports(sinks)
        mapping = self._mapping(root)
        if isinstance(mapping, MappingConfig):
            self._refuse_nowhere_to_begin(mapping, _section(root, "map"))
        begin_in = getattr(sinks["map"], "load", None)
        read = {"vehicle": name, "sensors": sensors, "mapping": mapping, "sinks": sinks}
        return {**read, "replay": self._choice(root), "begin_in": begin_in}

    def read_for_replay(self) -> dict[str, Any]:
        """Sensors, mapping and replay, each as far as it is there; a wire that is not given stays unused."""
        if (root := self._root()) is None:
            return {}
        sensors = root.get("sensors")
        if isinstance(sensors, dict):
            sensors = {name: _with_a_wire(settings) for name, settings in sensors.items()}
        read = self._sensors(sensors) if sensors is not None else {}
        stored = _section(root, "map")
        load = stored.get("load") if isinstance(stored, dict) else None
        begin_in = Path(load) if isinstance(load, str) else None
        mapping, choice = self._mapping(root), self._choice(root)
        return {"sensors": read, "mapping": mapping, "replay": choice, "begin_in": begin_in}

    def read_publishing(self) -> BaseModel | None:
        """That section; the others are not looked at."""
        if (root := self._root()) is None:
            return None
        publishing = self._model(PublishingConfig, _section(root, "publishing"), ("publishing",))
        self._refuse_shared_ports({"publishing": publishing})
        return publishing

    def _root(self) -> dict[str, Any] | None:
        """None where there is nothing to look at; why is reported then."""
        root = self._document.value
        if root is None and self._document.faults:
            return None
        if not isinstance(root, dict):
            self._fault((), f"a config is a mapping with the keys {', '.join(_KEYS)}")
            return None
        for key in root.keys() - set(_KEYS):
            self._fault((key,), unknown_key(key, root[key], _KEYS))
        return root

    def _mapping(self, root: dict[str, Any]) -> BaseModel | None:
        section = _section(root, "mapping")
        model = mapping_model(section) if isinstance(section, dict) else MappingConfig
        return self._model(model, section, ("mapping",))

    def _choice(self, root: dict[str, Any]) -> BaseModel | None:
        return self._model(Choice, _section(root, "replay"), ("replay",))

    def _name(self, parent: KeyPath, name: object, key: str) -> object:
        if name is None:
            self._fault(parent, f'"{key}" is missing; write {key}: veh1, say')
        elif not isinstance(name, str):
            self._fault((*parent, key), f'a name is text; write {key}: "{name}", or veh{name}')
        elif fault := _name_fault(name):
            self._fault((*parent, key), fault)
        return name

    def _sensors(self, sensors: object) -> dict[str, BaseModel]:
        path: KeyPath = ("sensors",)
        if not isinstance(sensors, dict) or not sensors:
            kinds = " or ".join(SENSOR_KINDS)
            self._fault(
                path,
                f"no sensors; write front: {{type: sick_lms100, host: 192.168.0.1}}, say (types: {kinds})",
            )
            return {}
        read: dict[str, BaseModel] = {}
        for name, settings in sensors.items():
            if fault := _name_fault(name) or (
                "reserved for the service itself" if name in RESERVED_NAMES else ""
            ):
                self._fault((*path, name), fault)
            if (sensor := self._sensor(name, settings, (*path, name))) is not None:
                read[name] = sensor
        return read

    def _sensor(self, name: str, settings: object, path: KeyPath) -> BaseModel | None:
        if not isinstance(settings, dict):
            self._fault(path, "a sensor is a mapping; write {type: sick_lms100, host: 192.168.0.1}, say")
            return None
        if "name" in settings:
            self._fault((*path, "name"), f"the key is the name already ({name}); take this line out")
        settings = {**settings, "name": name}
        kind = settings.get("type")
        if isinstance(kind, str) and kind in SENSOR_KINDS:
            return self._model(SENSOR_KINDS[kind].config, settings, path)
        where = (*path, "type") if "type" in settings else path
        problem = f"{kind!r} is no type of sensor" if "type" in settings else '"type" is missing'
        self._fault(where, f"{problem}; {suggest(str(kind), SENSOR_KINDS)}")
        self._refuse_what_no_type_takes(settings, path)
        return None

    def _refuse_what_no_type_takes(self, settings: dict[str, Any], path: KeyPath) -> None:
        """Where the type is wrong: the faults that every type finds which may have been meant."""
        before = self._document.faults
        found: list[list[Fault]] = []
        for kind in _kinds_meant(settings):
            self._document.faults = list(before)
            self._model(SENSOR_KINDS[kind].config, {**settings, "type": kind}, path)
            found.append(self._document.faults[len(before) :])
        self._document.faults = [
            *before,
            *(fault for fault in found[0] if all(fault in others for others in found[1:])),
        ]

    def _refuse_shared_wires(self, sensors: Mapping[str, BaseModel]) -> None:
        owners: dict[tuple[object, ...], str] = {}
        for name, sensor in sensors.items():
            for keys in (("host", "port"), ("device",)):
                wire = tuple(getattr(sensor, key, None) for key in keys)
                if None in wire:
                    continue
                spelt = (one_spelling(str(wire[0])), *wire[1:]) if keys[0] == "host" else wire
                owner = owners.setdefault(spelt, name)
                if owner != name:
                    where = ":".join(map(str, wire))
                    fault = f"{where} is taken by {owner}; two sensors cannot share a wire"
                    self._fault(("sensors", name, keys[0]), fault)

    def _refuse_shared_ports(self, sinks: Mapping[str, BaseModel | None]) -> None:
        """Of two listeners at one port the second could not start. Port 0 is any free one."""
        taken: list[tuple[str, int, str]] = []
        for section, sink in sinks.items():
            for host, port in getattr(sink, "tcp_addresses", ()):
                for other, its_port, owner in taken:
                    hosts = {one_spelling(host), one_spelling(other)}
                    is_one_family = len({":" in one for one in hosts}) == 1
                    is_shared = is_one_family and (len(hosts) == 1 or hosts & _ANY_ADDRESS)
                    if port == its_port != 0 and is_shared:
                        fault = f"port {port} is taken by {owner}.listen; give each a port of its own"
                        self._fault((section, "listen"), fault)
                taken.append((host, port, section))

    def _refuse_own_topics(self, sensors: Mapping[str, BaseModel], ros2: Ros2Config) -> None:
        """What goes out must not come in again."""
        for name, sensor in sensors.items():
            topic, domain = getattr(sensor, "topic", None), getattr(sensor, "domain", None)
            if ros2.enabled and ros2.domain == domain and topic in own_topics(ros2.namespace, sensors):
                fault = f"{topic} is published by corridor itself; give publishing.ros2 a namespace"
                self._fault(("sensors", name, "topic"), fault)

    def _refuse_nowhere_to_begin(self, mapping: MappingConfig, section: object) -> None:
        is_given = isinstance(section, dict) and section.get("load") is not None
        if mapping.mode == "localization" and not is_given:
            self._fault(
                ("mapping", "mode"), "localization is in a stored map; name its folder in map: {load: ...}"
            )
        if is_given and not begins_in_stored(mapping):
            self._fault(
                ("mapping", "profile"),
                f"{mapping.profile} cannot begin in a stored map; use corridor, or leave map.load out",
            )

    def _model(self, model: type[BaseModel], settings: object, path: KeyPath) -> BaseModel | None:
        return validated(self._document, path, model, settings, own_keys=("name",))

    def _fault(self, path: KeyPath, message: str) -> None:
        add_fault(self._document, path, message)


def _with_a_wire(settings: object) -> object:
    """A sensor's settings for a replay, which opens no wire."""
    if not isinstance(settings, dict) or {"host", "device"} & settings.keys():
        return settings
    kind = settings.get("type")
    if not isinstance(kind, str) or kind not in SENSOR_KINDS:
        return settings
    fields = SENSOR_KINDS[kind].config.model_fields
    key = next((key for key in ("host", "device") if key in fields), None)
    return settings if key is None else {**settings, key: "recorded"}


def _kinds_meant(settings: Mapping[str, Any]) -> list[str]:
    """Types of sensor that someone may have meant: the one spelt alike, else those with most of the keys."""
    if near := difflib.get_close_matches(str(settings.get("type")), list(SENSOR_KINDS), n=1):
        return near
    known = {kind: len(settings.keys() & SENSOR_KINDS[kind].config.model_fields) for kind in SENSOR_KINDS}
    return [kind for kind, count in known.items() if count == max(known.values())]


def _section(root: Mapping[str, Any], key: str) -> Any:
    """What stands under the key; a section left out or left empty has its defaults."""
    return {} if root.get(key) is None else root[key]


def _name_fault(name: str) -> str:
    if is_name(name):
        return ""
    offer = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:MAX_NAME_LENGTH]
    example = f"; {offer} would do" if is_name(offer) else ""
    return f'"{name}" becomes part of Zenoh keys and ROS names, so it takes {NAME_RULE}{example}'
