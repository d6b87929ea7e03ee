"""Start poses as RViz sends them: a pose on Zenoh becomes the command set_pose."""

import json
import logging
import math
import threading
from collections.abc import Callable

import zenoh

from service.encoding import MAP_FRAME, decode_initial_pose
from service.errors import InputError
from service.publishing.commands import Answer

log = logging.getLogger(__name__)

CHANNEL = "initialpose"
CLOSE_TIMEOUT_S = 10.0


class InitialPoseSubscriber:
    """Open when constructed. `answer` takes verb and payload; it may wait, in bounded time.

    Of poses that come faster than they are answered the newest counts. owner: the sink whose thread this is.
    """

    def __init__(
        self, session: zenoh.Session, key: str, answer: Callable[[str, bytes], Answer], owner: str = "zenoh"
    ) -> None:
        self._answer = answer
        self._changed = threading.Condition()  # of the two below
        self._waiting: tuple[str, bytes] | None = None  # key and payload
        self._closed = False
        self.refused = ""  # why the newest one was not taken, "" if it was
        self._thread = threading.Thread(target=self._run, name=f"{owner}-initialpose", daemon=True)
        self._thread.start()
        # Called where Zenoh reads: its thread of callbacks can still hold a pose when close() ends it.
        taken = zenoh.handlers.Callback(self._take, indirect=False)
        self._subscriber = session.declare_subscriber(key, taken)

    def close(self) -> None:
        """Accept no more poses, and wait for the answer in progress; a late one is logged."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(CLOSE_TIMEOUT_S)
        if self._thread.is_alive():
            log.error("%s: what came last is not answered after %.0f s", CHANNEL, CLOSE_TIMEOUT_S)

    def _take(self, sample: zenoh.Sample) -> None:
        """Hand the pose on; Zenoh's own thread, which waits for it."""
        with self._changed:
            self._waiting = str(sample.key_expr), sample.payload.to_bytes()
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is not None or self._closed)
                taken, self._waiting = self._waiting, None
            if taken is None:
                return
            self.refused = self._set_pose(*taken)
            if self.refused:
                log.warning("%s", self.refused)

    def _set_pose(self, key: str, payload: bytes) -> str:
        """Why it was not taken, "" if it was."""
        if "*" in key:
            return f"{CHANNEL}: a pose for {key}; a pose, as a command, is for one vehicle, without wildcards"
        try:
            frame, pose = decode_initial_pose(payload)
        except InputError as error:
            return f"{CHANNEL}: {error}"
        if frame.lstrip("/") != MAP_FRAME:
            return f"{CHANNEL}: a pose in the frame {frame!r}; expected {MAP_FRAME!r}"
        if not all(map(math.isfinite, pose)):
            return f"{CHANNEL}: ({pose.x_m}, {pose.y_m}) m, {pose.theta_rad} rad is no pose"
        answer = self._answer("set_pose", json.dumps(pose._asdict()).encode())
        if not answer.ok:
            return f"{CHANNEL}: {json.loads(answer.body)['error']}"
        log.info("%s: looked for at (%.2f, %.2f) m, %.2f rad", CHANNEL, pose.x_m, pose.y_m, pose.theta_rad)
        return ""
