"""Shows the operator's page the map of a running session: a process of its own.

The session goes on extending its map while a person looks at it. So what is looked at is a version as it was
saved, held here. Key frames of it and of the map as it is later are the same where their stamps are.

One request a line of stdin, its answer a line of stdout, both JSON: {"verb", "map", "request"} and
{"ok", "error" or what was asked for}. It ends with its stdin, or where nothing is asked for IDLE_S.
"""

import json
import os
import secrets
import select
import sys
from pathlib import Path
from typing import Any, BinaryIO

from pydantic import TypeAdapter

from service.errors import CorridorError, InputError
from service.mapstore.files import StoredMap, load_map
from service.offline.maps import edit as map_edit
from service.offline.maps.asked import KeyframeOfSession, read_as
from service.offline.maps.commands import look, look_at_keyframe

IDLE_S = 900.0  # then the memory of the map is given back; the page looks again

_KEYFRAME = TypeAdapter[Any](KeyframeOfSession)


class SessionMapCommands:
    """One request after the other. Holds what was looked at last."""

    def __init__(self) -> None:
        self._seen: StoredMap | None = None
        self._name = ""  # of that look, unlike that of any other

    def answer(self, line: bytes) -> dict[str, Any]:
        """What becomes of a request; what cannot be done is said in words."""
        asked = json.loads(line)
        folder, request = Path(asked["map"]), json.dumps(asked["request"]).encode()
        try:
            return {"ok": True, **self._carry_out(asked["verb"], folder, request)}
        except CorridorError as error:
            return {"ok": False, "error": str(error).removeprefix(f"{folder}: ")}

    def _carry_out(self, verb: str, folder: Path, request: bytes) -> dict[str, Any]:
        match verb:
            case "look":
                self._seen, self._name = load_map(folder), secrets.token_hex(8)
                return {**look(self._seen), "seen": self._name, "user": map_edit.user_name()}
            case "keyframe":
                wanted: KeyframeOfSession = read_as(_KEYFRAME, request)
                return look_at_keyframe(self._looked_at(wanted.seen), wanted.keyframe)
        raise InputError(f"{verb}: look and keyframe are known")

    def _looked_at(self, name: str) -> StoredMap:
        if self._seen is None or name != self._name:
            raise InputError("another page has fetched key frames since, or it is long ago; fetch them again")
        return self._seen


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
