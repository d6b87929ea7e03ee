"""What a replay maps, and how: by --config, else by the recording's own config, else by defaults."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from service.config import (
    ReplayConfig,
    laser_names,
    load_replay_config,
    mapped_lasers,
    mountings,
    parse_replay_config,
    recorded_config,
)
from service.errors import ConfigError, InputError, UsageError
from service.geometry.se2 import SE2
from service.mapper.profiles import METHODS, MappingConfig, begins_in_stored, mapping_config, with_profile
from service.mapstore.begin_in import MapVersion, recorded_version
from service.mapstore.files import has_version
from service.offline.replay.raw import FROM_RAW
from service.recording.choice import NO_CHOICE, Choice
from service.recording.mcap_source import Session

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """How to replay. Each None leaves it to the recording, which holds the config it was made with."""

    config: Path | None = None
    profile: str | None = None
    rate: float = 0.0  # times real time; 0: as fast as it goes
    map: Path | None = None  # a stored map to begin in
    version: int | None = None  # of it; None: that in which the recording began, else the newest
    localize: bool = False  # ... which stays as it is
    choice: Choice = field(default_factory=Choice)  # topics and frames; what is not set is as in the config
    mapping: Mapping[str, Any] = field(default_factory=dict)  # laid over the mapping section of the config
    from_raw: bool = False  # map what the drivers make of the recorded bytes, not the recorded frames


@dataclass(frozen=True, slots=True)
class ReplaySetup:
    """How a recording is mapped.

    poses_base_sensor   mountings of lasers, lever arms of antennas
    lasers              whose scans are mapped
    unmounted           of them, those without a mounting in config and recording
    map_version         of the stored map to begin in; None: the current one
    is_as_live          all is as it was live: what the mapper left out and when it applied results is
                        repeated from the recording
    """

    mapping: MappingConfig
    poses_base_sensor: Mapping[str, SE2]
    lasers: Sequence[str]
    unmounted: Sequence[str]
    map_version: int | None
    is_as_live: bool


def refuse_contradictions(options: ReplayOptions) -> None:
    """Raises UsageError where options do not go together, whatever the recording holds."""
    if options.localize and options.map is None:
        raise UsageError("--localize is in a stored map; name it by --map")
    if options.map is not None and options.profile is not None:
        fitting = [name for name in METHODS if begins_in_stored(mapping_config({"profile": name}))]
        if options.profile not in fitting:
            raise UsageError(
                f"--map: the profile {options.profile} cannot begin in a stored map; take --profile "
                f"{' or '.join(fitting)}, or leave one of the two out"
            )


def choice_of(options: ReplayOptions) -> Choice:
    """Topics and frames by the options, else by --config, else to be found. Raises ConfigError."""
    configured = NO_CHOICE if options.config is None else load_replay_config(options.config).replay
    return options.choice.over(configured)


def set_up(session: Session, options: ReplayOptions) -> ReplaySetup:
    """Raises ConfigError where the config cannot be used, and InputError where it maps no laser of these."""
    given = None if options.config is None else load_replay_config(options.config)
    recorded = recorded_config(session.recording, parse_replay_config, is_replaced=given is not None)
    config = given or recorded
    mapping = _mapping(config, options)
    configured = mountings(config.sensors) if config is not None else {}
    poses = {name: configured.get(name, pose) for name, pose in session.mountings.items()}
    begun_in = recorded_version(session.metadata.get("map", {}))
    version = _version(options, begun_in)
    poses |= session.antennas | {name: pose for name, pose in configured.items() if name not in poses}
    is_as_live = (
        recorded is not None
        and mapping == recorded.mapping
        and _begins_as_live(begun_in, options, version)
        and FROM_RAW not in session.metadata
    )
    if options.localize:
        mapping = mapping.model_copy(update={"mode": "localization"})
    if mapping.mode == "localization" and options.map is None:
        raise ConfigError(["mapping.mode is localization: give the map to localise in by --map"])
    if recorded is not None and recorded.begin_in is not None and options.map is None:
        log.warning(
            "the recording began in the stored map %s; this replay begins a new one. --map %s begins there",
            *(2 * [begun_in or recorded.begin_in]),
        )
    lasers = _lasers(session, config, bool(choice_of(options).scan_topics))
    unmounted = [name for name in lasers if name in session.unmounted and name not in configured]
    for name in unmounted:
        log.warning(
            "%s. If it sits elsewhere, map and poses are wrong: give a config that has %s and its mounting "
            "among its sensors by --config",
            *(session.unmounted[name], name),
        )
    return ReplaySetup(mapping, poses, lasers, unmounted, version, is_as_live)


def _version(options: ReplayOptions, begun_in: MapVersion | None) -> int | None:
    """Version of the stored map to begin in; None: the current one, or no map."""
    if options.map is None or options.version is not None or begun_in is None:
        return options.version
    if has_version(options.map, begun_in.number, begun_in.digest):
        log.info("beginning in version %d of %s, as the recording did", begun_in.number, options.map)
        return begun_in.number
    if options.map.resolve() == begun_in.folder:
        log.warning(
            "version %d of %s, in which the recording began, is not there any more: the newest takes its "
            "place, and poses will not be those of the recording",
            *(begun_in.number, options.map),
        )
    return None


def _begins_as_live(begun_in: MapVersion | None, options: ReplayOptions, version: int | None) -> bool:
    if begun_in is None or options.map is None:
        return begun_in is None and options.map is None
    return version == begun_in.number and has_version(options.map, version, begun_in.digest)


def _mapping(config: ReplayConfig | None, options: ReplayOptions) -> MappingConfig:
    mapping = config.mapping if config is not None else mapping_config()
    if options.profile is not None and options.profile != mapping.profile:
        try:
            mapping = with_profile(options.profile, mapping)
        except ValueError as error:
            raise ConfigError([f"--profile: {error}"]) from error
    if not options.mapping:
        return mapping
    section = mapping.model_dump(mode="json")
    overlay(section, options.mapping)
    return mapping_config(section)


def overlay(section: Any, values: Mapping[str, Any]) -> None:
    """Put values into a section of a config; of nested sections only what `values` names."""
    for key, value in values.items():
        if isinstance(value, Mapping) and isinstance(section.get(key), Mapping):
            overlay(section[key], value)
        else:
            section[key] = value


def _lasers(session: Session, config: ReplayConfig | None, are_named: bool) -> Sequence[str]:
    """Whose scans are mapped: as configured. Where that knows none of them, those of every laser that
    was named or whose mounting is known; where none is, of the one with most scans.
    """
    scans = session.scan_counts
    if config is None or not scans.keys() & laser_names(config.sensors):
        mounted = sorted(scans if are_named else scans.keys() - session.unmounted.keys())
        return mounted or [min(scans, key=lambda name: (-scans[name], name))]
    wanted = mapped_lasers(config)
    lasers = [name for name in wanted if name in scans]
    if not lasers:
        raise InputError(
            f"{session.recording.paths[0]}: the config maps {' and '.join(wanted) or 'no laser'}, but the "
            f"scans here are of {' and '.join(scans)}; give a config by --config that maps one of these"
        )
    return lasers
