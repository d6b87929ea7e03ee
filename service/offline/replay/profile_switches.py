"""Switches of the profile in a recording, as a replay meets them."""

import logging
from typing import Any

from service.errors import InputError
from service.mapper.mapping_session import SwitchProfile
from service.mapper.profiles import MappingConfig, with_profile

log = logging.getLogger(__name__)


class ProfileSwitches:
    """How frames are mapped from each switch on; the map begins again at each in any case.

    configured     as the replay begins; a switch back to its profile takes its settings from here
    is_followed    False: --profile names the profile of the replay. One that is only localised in a
                   stored map does not follow either, for no other profile can do that
    """

    def __init__(self, configured: MappingConfig, is_followed: bool) -> None:
        self.present = self._configured = configured
        self._is_followed = is_followed and configured.mode == "mapping"
        self._taken: list[dict[str, Any]] = []

    def take(self, step: SwitchProfile, first_log_ns: int) -> bool:
        """Whether `present` is another one now. Raises InputError where this version has no such profile."""
        at_s = round((step.arrived_ns - first_log_ns) / 1e9, 3)
        if not self._is_followed:
            log.warning(
                "%.3f s after its beginning the recording was mapped on with the profile %s; this replay "
                "stays with %s, and begins a new map there",
                *(at_s, step.profile, self.present.profile),
            )
            return False
        if step.profile == self._configured.profile:
            self.present = self._configured
        else:
            try:
                self.present = with_profile(step.profile, self._configured)
            except ValueError as error:
                raise InputError(
                    f"{at_s:.3f} s after its beginning the recording was mapped on with another profile: "
                    f"{error} Give the profile for the whole replay by --profile"
                ) from error
        self._taken.append({"at_s": at_s, "profile": step.profile})
        log.info(
            "%.3f s after the beginning: mapped on with the profile %s, in a new map", at_s, step.profile
        )
        return True

    def as_dict(self) -> dict[str, Any]:
        """For the summary: nothing where the profile stayed."""
        return {"profile_switches": self._taken} if self._taken else {}
