"""Settings of the Foxglove output."""

from typing import Annotated

from pydantic import AfterValidator

from drivers.section import Section
from service.web.config import check_listen


class FoxgloveConfig(Section):
    """A websocket for Foxglove and Lichtblick. It has no password: whoever reaches it sees everything."""

    enabled: bool = False  # needs the extra `viewer`
    listen: Annotated[str, AfterValidator(check_listen)] = "127.0.0.1:8765"
