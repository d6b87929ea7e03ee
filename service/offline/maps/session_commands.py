"""Shows the operator's page the map of a running session: a process of its own.

The session goes on extending its map while a person looks at it. So what is looked at is a version as it was
saved, kept here. Key frames of it and of the map as it is later are the same where their stamps are.

One request a line of stdin, its answer a line of stdout, both JSON: {"verb", "map", "request"} and
{"ok", "error" or the result}. It ends with its stdin, or without a request for IDLE_S.
"""

import json
import os
import secrets
import select
import sys
from pathlib import Path
from typing import Any, BinaryIO

from service.errors import CorridorError, InputError
from service.mapstore.files import StoredMap, load_map
from service.offline.maps import edit as map_edit
from service.offline.maps.commands import look, look_at_keyframe
from service.offline.maps.requests import KeyframeOfSession, Look, Table, carry_out

IDLE_S = 900.0  # then the memory of the map is given back; the page looks again


class SessionMapCommands:
    """One request after the other. Keeps the map viewed last."""

    def __init__(self) -> None:
        self._seen: StoredMap | None = None
        self._name = ""  # of that look, unlike that of any other

    def answer(self, line: bytes) -> dict[str, Any]:
        """Answer a request; a refused one with the reason."""
        requested = json.loads(line)
        folder, request = Path(requested["map"]), json.dumps(requested["request"]).encode()
        table: Table = {
            "look": (Look, lambda _: self._look(folder)),
            "keyframe": (KeyframeOfSession, self._keyframe),
        }
        try:
            return {"ok": True, **carry_out(table, requested["verb"], request)}
        except CorridorError as error:
            return {"ok": False, "error": str(error).removeprefix(f"{folder}: ")}

    def _look(self, folder: Path) -> dict[str, Any]:
        self._seen, self._name = load_map(folder), secrets.token_hex(8)
        return {**look(self._seen), "seen": self._name, "user": map_edit.user_name()}

    def _keyframe(self, requested: KeyframeOfSession) -> dict[str, Any]:
        if self._seen is None or requested.seen != self._name:
            raise InputError("another page has fetched key frames since, or it is long ago; fetch them again")
        return look_at_keyframe(self._seen, requested.keyframe)


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Until `requests` ends, or brings nothing for IDLE_S."""
    commands = SessionMapCommands()
    while select.select([requests], [], [], IDLE_S)[0] and (line := requests.readline()):
        answers.write(json.dumps(commands.answer(line)).encode() + b"\n")
        answers.flush()


if __name__ == "__main__":
    facts = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # nothing else comes between the answers
    serve(sys.stdin.buffer, facts)
