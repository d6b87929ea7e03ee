"""The folder of real captures and recordings that tests, benchmarks and the papers' experiments read."""

import os
from pathlib import Path

# $CORRIDOR_SHARED, else the folder `shared` beside that of the project
SHARED = Path(os.environ.get("CORRIDOR_SHARED", Path(__file__).parents[2] / "shared"))
NO_RECORDINGS = (
    f"no real recordings at {SHARED}; with them: CORRIDOR_SHARED=FOLDER make test "
    "(CONTRIBUTING says what is in FOLDER)"
)
