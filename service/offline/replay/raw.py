"""Runs a recording's raw bytes through the installed drivers, for `corridor replay --from-raw`.

The drivers run with the config that the recording holds, or with another one. Their frames are written to a
session of their own, in the order in which their bytes came; the events of the recording stand between them.
"""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from service.config import ServiceConfig, load_config, parse_config, recorded_config, tf_static
from service.encoding import LogClock, Message, decode_raw, encode_frame
from service.errors import InputError
from service.offline.importing.session_file import write_messages
from service.recording.mcap_reader import Recording
from service.recording.raw_wire import WireReplay, raw_topics, utc_offset_ns
from service.sensor_kinds import SENSOR_KINDS
from service.version import VERSION

log = logging.getLogger(__name__)

FROM_RAW = "from_raw"  # metadata of a session whose frames were made again


def remake_frames(
    paths: Sequence[Path],
    config: Path | None,
    out: Path,
    progress: Callable[[float], None] = lambda share: None,
) -> dict[str, dict[str, int]]:
    """Run the raw bytes of a recording through the drivers and write their frames as the session `out`.

    config   sensors and their settings; None: those that the recording holds

    The counts of each sensor's wire, as of WireReplay. Raises InputError where there are no raw bytes, no
    config, or no frame comes of them, ConfigError, and StorageError where `out` cannot be written.
    """
    recording = Recording(paths)
    if not (topics := raw_topics(recording)):
        raise InputError(
            f"{paths[0]}: no raw bytes to run through the drivers (no topic /<sensor>/raw); they are there "
            "where its config says recording: {raw: true}; replay it without --from-raw"
        )
    service = recorded_config(recording, parse_config) if config is None else load_config(config)
    if service is None:
        raise InputError(f"{paths[0]}: holds no config of its sensors; give one by --config")
    names = [name for name in service.sensors if name in topics]
    for name in service.sensors.keys() - topics.keys():
        log.warning("%s: no /%s/raw, so %s is left out", paths[0], name, name)
    for name in topics.keys() - service.sensors.keys():
        log.warning("%s: passed over /%s/raw: the config has no sensor %s", paths[0], name, name)
    wires = {
        name: WireReplay(SENSOR_KINDS[service.sensors[name].type].session_maker(service.sensors[name]))
        for name in names
    }
    channels = {topics[name].removeprefix("/"): name for name in names}
    metadata = {**recording.metadata, FROM_RAW: {"corridor": VERSION}}
    write_messages(out, _messages(recording, service, wires, channels, progress), metadata)
    _tell(paths[0], wires)
    return {name: wire.counts for name, wire in wires.items()}


def _messages(
    recording: Recording,
    service: ServiceConfig,
    wires: Mapping[str, WireReplay],
    sensors: Mapping[str, str],
    progress: Callable[[float], None],
) -> Iterator[Message]:
    """Mountings, frames made again and recorded events. sensors: channel of raw bytes -> sensor."""
    offset_ns, clock = utc_offset_ns(recording), LogClock()
    first_ns, span_ns = recording.first_log_ns, max(recording.last_log_ns - recording.first_log_ns, 1)
    yield tf_static(service.sensors, first_ns)
    for message in recording.messages([*(f"/{channel}" for channel in sensors), "/events"]):
        if message.channel not in sensors:
            yield message
            continue
        chunk = decode_raw(message.payload, message.log_ns, offset_ns)
        for frame in wires[sensors[message.channel]].take(chunk):
            yield encode_frame(frame, offset_ns, clock.next_ns(frame.arrived_ns + offset_ns))
        progress((message.log_ns - first_ns) / span_ns)


def _tell(path: Path, wires: Mapping[str, WireReplay]) -> None:
    """Raises InputError where not one frame was made."""
    if not any(wire.frames for wire in wires.values()):
        cut = [name for name, wire in wires.items() if wire.chunks_without_start]
        why = (
            f"{' and '.join(cut)} were recorded in mid-stream; give all files of the session from its start"
            if cut
            else f"the drivers make nothing of the bytes of {' and '.join(wires) or 'no sensor'}"
        )
        raise InputError(f"{path}: no frame comes of its raw bytes: {why}")
    for name, wire in wires.items():
        log.info("%s: %s", name, wire.counts)
        if wire.requests_not_repeated:
            log.warning(
                "%s: today's driver sends where that of the recording did not, or vice versa, "
                "%d times; its frames may differ from the recorded ones",
                name,
                wire.requests_not_repeated,
            )
