"""Settings of the recorder."""

from pydantic import Field

from drivers.section import Section
from service.config_types import Folder


class RecordingConfig(Section):
    """Folder of the sessions, and limits of their size."""

    directory: Folder
    rotate_mb: int = Field(default=1024, ge=1, le=100_000)
    rotate_min: float = Field(default=10.0, ge=0.1, le=1440.0)
    keep_free_gb: float = Field(default=2.0, ge=0.0, le=100_000.0)
    raw: bool = False  # also the bytes of the devices, as they came
