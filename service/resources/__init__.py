"""Files that travel with the program: config/, docs/ and systemd/ of the tree, also in the wheel.

In the tree these folders are links to those at its root; the wheel holds their files.
"""

from pathlib import Path

FOLDER = Path(__file__).parent
# vehicle.yaml, sensors/<type>.yaml, profiles/<profile>.yaml, layouts/foxglove.json
CONFIG = FOLDER / "config"
SYSTEMD = FOLDER / "systemd"
DOCS = FOLDER / "docs"  # the manual: *.md in it and below, */*.png
