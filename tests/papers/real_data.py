"""Every profile on recordings of real buildings: how far from the relations, what a scan costs."""

from collections.abc import Sequence
from functools import partial

from service.mapper.profiles import METHODS
from tests.papers.recorded import RELATIONS, scored
from tests.papers.report import Row, Scenario, Section, seeds_text

SPARSE = (
    "without an IMU the wheels predict, and with a scan in one to two seconds and turns of up to 137 deg "
    "between two the window is as wide as a door"
)
STEP_OFF = (
    "without an IMU the wheels predict, with a scan in one to two seconds; some are lost, and single "
    "relations are off by a metre and more, without which the bound would be met"
)
TURNS = (
    "the paper's filter predicts the heading by a gyro, and there is none: wheels that turn wrong by 475 deg "
    "in 640 s take its place, and a quarter of that enters each new scan's heading and stays in the map"
)
STEPS = (
    "on new ground a scan lies on the last ones alone, with 0.2 deg RMS; it is drawn there and stays, and "
    "over the first round of 787 scans the headings add up to 16 deg, which nothing takes out again"
)
NO_LOOP = (
    "the profile closes no loop, so that the heading which one scan has wrong stays in the map: small "
    "changes of the motion filter give 0.035 to 0.068 m"
)
PARTICLES = (
    "few scans, one in one to two seconds: which particles are drawn decides by centimetres (row with other "
    "seeds)"
)
CAUSES = {  # why a profile is worse than is asked for on a recording
    ("owolm_eskf", "intel"): TURNS,
    ("imle", "intel"): STEPS,
    ("contour_lm", "intel"): NO_LOOP,
    ("owolm_eskf", "csail"): SPARSE,
    ("owolm_eskf", "aces"): STEP_OFF,
    ("submap_graph", "aces"): PARTICLES,
}
DRAWN = ("aces", "csail")  # few scans: replayed with the random numbers of other seeds as well


def relations(name: str, seeds: Sequence[int]) -> Section:
    """Each profile beside the default on a building whose relations are known."""
    usual = scored("corridor", name)
    if usual is None:
        return Section("Not run", f"no recording {name}; set CORRIDOR_SHARED")
    rows = [
        Row(name, "corridor, the default", [usual.error_m], "m"),
        Row(name, "corridor: a scan, p50", [usual.scan_ms], "ms", digits=1),
    ]
    bound_m = round(2.0 * usual.error_m, 3)
    for profile in METHODS:
        if profile == "corridor":
            continue
        found = scored(profile, name)
        assert found is not None
        cause = CAUSES.get((profile, name), "")
        rows += [
            Row(name, profile, [found.error_m], "m", at_most=bound_m, cause=cause),
            Row(name, f"{profile}: a scan, p50", [found.scan_ms], "ms", digits=1),
        ]
        if profile == "submap_graph" and name in DRAWN:
            drawn = [scored(profile, name, {"matcher": {"seed": seed}}) for seed in seeds]
            errors_m = [one.error_m for one in drawn if one is not None]
            rows.append(Row(name, f"{profile}: drawn with {seeds_text(seeds)}", errors_m, "m"))
        if found.lost_share:
            rows.append(Row(name, f"{profile}: scans lost", [100.0 * found.lost_share], "%", digits=1))
    return Section(
        f"Beside the default profile: {name}",
        "Replays with every parameter at its default; mean error of the relations. Those of fr079 and intel "
        "are the official ones; those of aces and csail, of consecutive scans, come from another mapper's "
        "path and are good to 5 to 10 cm. The bound is twice the error of the default.",
        rows,
        ran_on="recordings",
    )


SCENARIOS: dict[str, Scenario] = {name: partial(relations, name) for name in RELATIONS}
