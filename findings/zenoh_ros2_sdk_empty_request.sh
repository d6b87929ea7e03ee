#!/bin/sh
# zenoh-ros2-sdk 0.1.8: type hash of a service with an empty request, and the depth of a history left open.
# Expected: compute_service_type_hash("std_srvs/srv/Trigger", "", "bool success\nstring message") gives the hash
#           of ROS 2, RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f: its code below has
#           a branch for empty requests. "::,:,:,:,," of rmw_zenoh means depth 42, its default.
# Found: ValueError "Service definition is required for request", before that branch; depth 10. Clients of Trigger
#        work where type_hash is given.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check zenoh-ros2-sdk==0.1.8
"$folder/venv/bin/python" - <<'PYTHON'
import importlib.metadata
import sys

from zenoh_ros2_sdk.qos import QosProfile
from zenoh_ros2_sdk.utils import compute_service_type_hash

print("zenoh-ros2-sdk", importlib.metadata.version("zenoh-ros2-sdk"))
try:
    found = compute_service_type_hash("std_srvs/srv/Trigger", "", "bool success\nstring message")
except ValueError as error:
    found = f"ValueError: {error}"
depth = QosProfile.decode("::,:,:,:,,").history_depth
print("Trigger:", found)
print("depth of a history left open:", depth)
sys.exit(0 if found.startswith("ValueError: Service definition is required") and depth == 10 else 1)
PYTHON
