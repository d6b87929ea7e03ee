"""Types that the config models of several parts share."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator


def _full_path(directory: Any) -> Any:
    """An empty path would be the folder in which the service happens to be started; a shell expands ~."""
    if isinstance(directory, str) and not directory.strip():
        raise ValueError("an empty path; write the folder, such as /var/lib/corridor/sessions")
    if isinstance(directory, str) and directory.startswith("~"):
        raise ValueError("~ is not expanded here; write the whole path, such as /home/me/sessions")
    return directory


Folder = Annotated[Path, BeforeValidator(_full_path)]
