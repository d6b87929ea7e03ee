"""Another profile while the service runs.

    request --refused at once, or--> its kernels, where they are not compiled yet --> the map saved --> at one
    place among the frames: the mapper begins a new map with it --> the map before saved --> answered

Until that place nothing has changed: what fails before it leaves the profile as it is.
"""

import logging
import os
import threading
from collections.abc import Callable, Mapping
from multiprocessing import get_context
from typing import Annotated, Any

from pydantic import Field

from service.compile.cache import is_warm
from service.encoding import Message
from service.interruption import children_do_not_hear, end_with_parent
from service.mapper.profiles import MappingConfig, begins_in_stored, mapping_config, with_profile
from service.publishing.commands import CommandError, Outcome, Request, Verb
from service.runtime.intake import Intake
from service.runtime.mapper_messages import Answer
from service.runtime.mapping_outputs import MappingOutputs
from service.sinks.sink import MapStorage, SavedMap

log = logging.getLogger(__name__)

VERB = "switch_profile"
COMPILE_TIMEOUT_S = 900.0  # ten times what all kernels of a profile take on a free core
NICENESS = 10  # of the process that compiles, while frames are mapped
Section = Mapping[str, Any]  # of a config: mapping


class ProfileRequest(Request):
    """profile: one of service.mapper.profiles.METHODS."""

    profile: Annotated[str, Field(min_length=1, max_length=100)]


class PresentMapping:
    """The present mapping section: as configured, or as of the newest switch.

    A later switch back to the profile of the config takes its settings from there again.
    """

    def __init__(self, configured: MappingConfig) -> None:
        self.configured = self.config = configured

    @property
    def profile(self) -> str:
        return self.config.profile

    def with_profile(self, profile: str) -> MappingConfig:
        """The mapping section after a switch to that profile. Raises CommandError where it is refused."""
        if self.config.mode == "localization":
            raise CommandError(
                "this session is localised in a stored map, which stays as it is; only the profile "
                f"{self.profile} does that. Start the service with mapping.mode: mapping to switch"
            )
        if profile == self.profile:
            raise CommandError(f"{profile} is the profile that maps now; reset_map begins a new map with it")
        if profile == self.configured.profile:
            return self.configured
        try:
            return with_profile(profile, self.configured)
        except ValueError as error:
            raise CommandError(str(error)) from error


def make_kernels_ready(section: Section) -> None:
    """Like compile_kernels; returns at once where those of all profiles are compiled, as after `warmup`."""
    if not is_warm():
        compile_kernels(section)


def compile_kernels(section: Section) -> None:
    """Have the kernels for a mapping section in the cache when this returns, made by a process of its own.

    Raises CommandError where it failed, or took longer than COMPILE_TIMEOUT_S.
    """
    with children_do_not_hear():
        process = get_context("spawn").Process(target=_compile, args=(dict(section),), daemon=True)
        process.start()
    process.join(COMPILE_TIMEOUT_S)
    if process.exitcode is None:
        process.kill()
        process.join()
        raise CommandError(
            f"the kernels of {section.get('profile')} were not compiled within {COMPILE_TIMEOUT_S:.0f} s; "
            "the profile stays. corridor warmup compiles them without a vehicle"
        )
    if process.exitcode:
        raise CommandError(
            f"the kernels of {section.get('profile')} could not be compiled: that process ended with code "
            f"{process.exitcode}, its log says why. The profile stays"
        )


def _compile(section: dict[str, Any]) -> None:
    from service.compile.warm_up import warm_up  # with numba, which ingest itself does without

    end_with_parent()
    stand_back()
    mapping_config(section)  # imports what calls them
    warm_up()


def stand_back() -> None:
    """Restrict this process to one core, at the lowest priority. The warm-up then starts no
    helpers, which this process, a daemon of multiprocessing, may not have.
    """
    os.nice(NICENESS)
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def new_map(
    outcome: Outcome,
    outputs: MappingOutputs,
    storage: MapStorage,
    begun: Callable[[], None],
    done: str,
    **facts: Any,
) -> None:
    """The mapper has begun another map: end the one before. The command is answered when that is on disk.

    begun   reports to the storage what the present map is
    done    for the answer where the map before cannot be saved
    facts   for the answer, besides both folders
    """
    ended = outputs.map_reset()
    before = None if ended is None else str(storage.folder_of(ended))
    begun()

    def saved(present: SavedMap | None, fault: str) -> None:
        if fault:
            outcome.failed(f"{done}, but the map before is not saved yet: {fault}")
        else:
            outcome.done(**facts, folder=str(storage.folder), folder_before=before)

    storage.ask_to_save(saved)


class ProfileSwitch:
    """One switch at a time.

    prepare    has the kernels for a section in the cache when it returns; raises CommandError
    """

    def __init__(
        self,
        present: PresentMapping,
        intake: Intake,
        outputs: MappingOutputs,
        put: Callable[[Message], Any],
        storage: MapStorage,
        prepare: Callable[[Section], None] = make_kernels_ready,
    ) -> None:
        self._present = present
        self._intake = intake
        self._outputs = outputs
        self._put = put
        self._storage = storage
        self._prepare = prepare
        self._lock = threading.Lock()  # of what follows
        self._newest: Outcome | None = None

    def verb(self, keep: Callable[[Outcome], None]) -> Verb:
        """keep: takes the outcome, which is to be settled when the service ends."""

        def start(request: ProfileRequest, outcome: Outcome) -> None:
            with self._lock:
                if self._newest is not None and not self._newest.settled:
                    raise CommandError("another switch is in progress; ask again when it is done")
                chosen = self._present.with_profile(request.profile)
                self._newest = outcome
            keep(outcome)
            event = {"event": VERB, **request.model_dump(exclude_none=True)}
            threading.Thread(
                target=self._make_ready, args=(event, chosen, outcome), name="switch-profile", daemon=True
            ).start()

        return Verb(ProfileRequest, start)

    def _make_ready(self, event: Mapping[str, Any], chosen: MappingConfig, outcome: Outcome) -> None:
        section = chosen.model_dump(mode="json", exclude_defaults=True)
        try:
            self._prepare(section)
        except CommandError as error:
            outcome.failed(str(error))
            return

        def saved(present: SavedMap | None, fault: str) -> None:
            if fault:
                outcome.failed(f"the profile stays, for the map cannot be saved: {fault}")
            elif refused := self._intake.mark(event, lambda marked: self._switch(marked, chosen, outcome)):
                outcome.failed(refused)

        def save() -> None:
            self._storage.ask_to_save(saved, with_graph=True)

        if refused := self._intake.hand_over_tiles(save):
            outcome.failed(refused)

    def _switch(self, event: Message, chosen: MappingConfig, outcome: Outcome) -> None:
        self._put(event)

        def begun() -> None:
            self._present.config = chosen
            self._storage.mapped_by(chosen.profile, begins_in_stored(chosen))
            log.info("the profile is %s now", chosen.profile)

        def answered(answer: Answer) -> None:
            if answer.error:
                outcome.failed(f"the profile stays: {answer.error}")
                return
            done = f"{chosen.profile} maps now"
            new_map(outcome, self._outputs, self._storage, begun, done, profile=chosen.profile)

        section = chosen.model_dump(mode="json", exclude_defaults=True)
        self._intake.request_profile(section, event.log_ns, answered)
