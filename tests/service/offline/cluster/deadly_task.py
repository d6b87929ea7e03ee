"""Tasks that kill their process, or that of the command; by themselves, as each worker imports them."""

import logging
import os
import signal
from dataclasses import dataclass
from pathlib import Path

from service.offline.cluster.tasks import Done


@dataclass(frozen=True)
class DeadlyTask:
    """Kills its process by its first works, `times` of them; what it counts them by is at `place`."""

    place: Path
    times: int
    program: str = ""

    @property
    def name(self) -> str:
        return self.place.name

    @property
    def deaths(self) -> int:
        return len(self.place.read_text()) if self.place.exists() else 0

    def work(self) -> Done:
        if self.deaths < self.times:
            logging.getLogger("service").info("begins")
            with self.place.open("a") as file:
                file.write("x")
            os.kill(os.getpid(), signal.SIGKILL)
        return Done({"deaths": self.deaths}, {})


@dataclass(frozen=True)
class OrphanedTask:
    """Writes the process it runs in to `place`, and kills that of the command."""

    place: Path
    program: str = ""

    @property
    def name(self) -> str:
        return self.place.name

    def work(self) -> Done:
        self.place.write_text(str(os.getpid()))
        os.kill(os.getppid(), signal.SIGKILL)
        return Done({}, {})
