"""Settings of the map saver."""

from pydantic import Field

from drivers.section import Section
from service.config_types import Folder


class MapConfig(Section):
    """Where the map is kept, and how often it is saved during a session."""

    directory: Folder
    load: Folder | None = None  # a stored map that the session begins in; None: a new map
    resume_within_s: float = Field(default=60.0, ge=0.0, le=86400.0)  # after it was killed; 0: never
    checkpoint_s: float = Field(default=30.0, ge=1.0, le=3600.0)
