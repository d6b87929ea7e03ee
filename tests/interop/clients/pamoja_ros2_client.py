"""Names, types, hashes and keys, as pamoja makes them from the names of ROS 2."""

from pamoja.ros2 import (
    dds_type_name,
    entity_key,
    is_fully_qualified,
    is_valid_name,
    percent_mangle,
    type_hash_digest,
)
from reporting import expect, facts, report

WANTED = facts()
for named in WANTED["names"]:
    name, kind = named["name"], named["type"]
    expect(is_valid_name(name) and is_fully_qualified(name), f"{name} is no name of ROS 2")
    expect(
        dds_type_name(kind) == named["dds_type"], f"{kind}: {dds_type_name(kind)}, not {named['dds_type']}"
    )
    digest = type_hash_digest(named["hash"])
    expect(digest is not None, f"{named['hash']} is no type hash")
    expect(f"RIHS01_{bytes(digest).hex()}" == named["hash"], f"{named['hash']} is read as {digest}")
    key = entity_key(WANTED["domain"], name, kind, named["hash"])
    expect(key == named["key"], f"{key}, not {named['key']}")
    expect(percent_mangle(name) == named["mangled"], f"{percent_mangle(name)}, not {named['mangled']}")
report(names=len(WANTED["names"]))
