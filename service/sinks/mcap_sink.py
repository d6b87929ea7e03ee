"""Every message into MCAP sessions, as a sink."""

import json
from collections.abc import Mapping
from pathlib import Path

from drivers.counted import counted
from service.encoding import ERROR, OK, WARNING, Message, Status, encode_event
from service.errors import StorageError
from service.outputs import reason_value
from service.recording.config import RecordingConfig
from service.recording.mcap_recorder import McapRecorder, State
from service.recording.session_change import SessionHeard
from service.sinks.sink import Sink, SinkContext

_LEVELS = {
    "waiting": OK,
    "recording": OK,
    "finished": OK,
    "stopped": WARNING,
    "disk full": ERROR,
    "disk error": ERROR,
}
_REASONS: Mapping[State, dict[str, str]] = {
    "stopped": reason_value("recording_stopped"),
    "disk full": reason_value("disk_full"),
    "disk error": reason_value("disk_error"),
}


class McapSink(Sink):
    """Records from `start` on; a SessionRecorder."""

    name = "recording"

    def __init__(self, config: RecordingConfig, context: SinkContext) -> None:
        self.wants_raw = config.raw
        self._directory = config.directory
        self._is_paused = context.is_paused
        self._profile, self._present_profile = context.profile, context.present_profile
        self._recorder = McapRecorder(
            config.directory,
            context.vehicle,
            rotate_bytes=config.rotate_mb << 20,
            rotate_s=config.rotate_min * 60.0,
            keep_free_bytes=round(config.keep_free_gb * 1e9),
            metadata=context.metadata,
        )

    def start(self) -> None:
        """Raises StorageError where the directory cannot be written."""
        self._recorder.start()

    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        self._recorder.put(message)

    def put_metadata(self, name: str, values: Mapping[str, str]) -> None:
        self._recorder.put_metadata(name, values)

    def begin_session(self, first: Message, heard: SessionHeard) -> None:
        """As McapRecorder.begin_session. A session holds all that its replay needs: one that begins after a
        switch of the profile, or in a pause, states it in the messages after its first.
        """
        self._recorder.begin_session(first, heard)
        if (profile := self._present_profile()) != self._profile:
            reason = "switched before the recording began"
            self._tell(first, {"event": "switch_profile", "profile": profile, "reason": reason})
        if self._is_paused():
            self._tell(first, {"event": "pause", "reason": "paused before the recording began"})

    def _tell(self, first: Message, event: Mapping[str, str]) -> None:
        self._recorder.put(encode_event(json.dumps(dict(event)), first.stamp_ns, first.log_ns))

    def end_session(self, heard: SessionHeard) -> None:
        self._recorder.end_session(heard)

    @property
    def why_not_recording(self) -> str:
        health = self._recorder.health
        if _LEVELS[health.state] == OK:
            return ""
        if health.state == "stopped":
            return "no session is being recorded; start_recording begins one"
        return f"nothing is recorded: {health.last_error}"

    def health(self) -> Status:
        recorder = self._recorder.health
        level = _LEVELS[recorder.state]
        values = {
            "state": recorder.state,
            "file": str(recorder.path or ""),
            "messages": str(recorder.messages),
            "free_gb": f"{recorder.free_bytes / 1e9:.1f}",
            "log_time_steps_back": str(recorder.steps_back),
        }
        dropped = dict(recorder.dropped)  # in one step: the recorder's thread goes on counting
        values |= {f"dropped.{channel}": str(count) for channel, count in sorted(dropped.items())}
        words = {OK: recorder.state, WARNING: "stopped by a command; Start records again"}.get(
            level, recorder.last_error
        )
        return Status(self.name, level, words, values | _REASONS.get(recorder.state, {}))

    def place(self) -> str:
        return str(self._directory)

    def status_words(self) -> str:
        recorder = self._recorder.health
        is_writing = recorder.path is not None and recorder.state == "recording"
        return f"recording: {recorder.path.name if recorder.path and is_writing else recorder.state}"

    def written(self) -> list[Path]:
        return list(self._recorder.health.finished)

    def close(self) -> None:
        """Raises StorageError where the disk did not take what was to be recorded."""
        self._recorder.finish()
        health, unfinished = self._recorder.health, self._recorder.unfinished
        if not unfinished and health.state != "disk error":
            return
        words = [f"recording: {health.last_error or 'the disk did not take it in time'}"]
        if dropped := sum(dict(health.dropped).values()):
            words.append(f"{counted(dropped, 'message')} dropped")
        if unfinished:
            files = ", ".join(map(str, unfinished))
            words.append(f"unfinished: {files}; the next start finishes them, or `corridor recover FILE`")
        raise StorageError("; ".join(words))
