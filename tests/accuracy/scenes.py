"""Scenes in which a source of motion is wrong: `python -m tests.accuracy.scenes --scene escort` runs one.

A vehicle drives through a place that stands still; then something happens for some seconds; then it is
still again.
"""

import argparse
import gc
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import groupby, product
from operator import itemgetter

from service.compile.warm_up import warm_up
from service.mapper.profiles import import_methods, mapping_config
from tests.accuracy.scene_drives import AFTER_S, BEFORE_S, PLACES, SCENES, Case, Staged, seconds_of, staged
from tests.accuracy.scene_judge import RIGHT_M, SIGMAS, WITHIN_M, WRONG_M, Verdict, judge, trace
from tests.accuracy.scene_recordings import RECORDINGS, recording_of, replayed
from tests.accuracy.trials import ghost_cells
from tests.papers.report import Row, Section
from tests.simulated import Run, run_session

GONE_S = 2.0  # a place where a person was so lately may be shown occupied
MOMENTS = 6  # of a lap
SPEEDS_MPS = (1.0, 0.6, 2.0, 0.3, 1.5)
SHARES = (0.33, 0.55, 0.2, 0.7)
NEEDLESS = ("needless_percent", "needless_still_percent", "lost_percent")  # of a Verdict, in the table
WORST = (
    ("fault_m", "m"),
    ("fault_percent", "%"),
    ("end_m", "m"),
    ("end_percent", "%"),
    ("right_after_s", "s"),
)


def mapped(of: Staged, profile: str = "corridor") -> Run:
    return run_session(mapping_config({"profile": profile}), of.made)


def verdict_of(of: Staged, done: Run, profile: str = "corridor") -> Verdict:
    """Ghosts: those that the same drive does not have where nothing happens."""
    truth = [of.made.truth[output.stamp_ns] for output in done.outputs]
    still = replace(of.case, scene="still", share=0.0, for_s=seconds_of(of.case))
    ghosts = ghost_cells(of.world, of.made, done, GONE_S)
    return judge(done.outputs, truth, of.from_ns, of.to_ns, ghosts - _ghosts_without(still, profile))


@lru_cache(maxsize=64)
def _ghosts_without(still: Case, profile: str) -> int:
    of = staged(still)
    return ghost_cells(of.world, of.made, mapped(of, profile), GONE_S)


def cases_of(scene: str, world: str, seeds: Sequence[int], moments: int) -> list[Case]:
    """One for each seed and moment; speeds and shares take turns, in every combination after 20 cases."""
    cases = []
    for k, seed in enumerate(seeds):
        for m in range(moments):
            number = k * moments + m
            moment = (m + (k + 0.5) / len(seeds)) / moments
            speed, share = SPEEDS_MPS[number % len(SPEEDS_MPS)], SHARES[number % len(SHARES)]
            cases.append(Case(scene, world, seed, moment, speed, share))
    return cases


def table(verdicts: Mapping[tuple[str, str], Sequence[Verdict]]) -> str:
    """In Markdown, a line for each scene and world: counts are sums, the others worst of all runs."""
    lines = [
        "| scene | world | runs | `ok`, 0.3 m off | `ok` beyond | needless | needless, still | lost "
        "| off after it | of its distance | off at the end | of the distance | right after | ghosts |",
        "|---|---|" + "---:|" * 12,
    ]
    for (scene, world), of in verdicts.items():
        cells = [
            str(len(of)),
            str(sum(v.ok_off for v in of)),
            str(sum(v.ok_beyond for v in of)),
            *(f"{max(getattr(v, what) for v in of):.1f} %" for what in NEEDLESS),
            *(f"{max(getattr(v, what) for v in of):.2f} {unit}" for what, unit in WORST),
            str(max(v.ghosts for v in of)),
        ]
        lines.append(f"| {scene} | {world} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def scenes(seeds: Sequence[int]) -> Section:
    verdicts: dict[tuple[str, str], list[Verdict]] = {}
    for scene in SCENES:
        for world in PLACES:
            verdicts[scene, world] = []
            for case in cases_of(scene, world, seeds, MOMENTS):
                of = staged(case)
                verdicts[scene, world].append(verdict_of(of, mapped(of)))
                gc.collect()
    for name in RECORDINGS:
        if recording_of(name).exists():
            verdicts[name, "given"] = [replayed(name).verdict]
    return Section(
        "Scenes in which a source of motion is wrong",
        f"Still for {BEFORE_S:.0f} s, then the scene, then still for {AFTER_S:.0f} s; LMS-100 "
        f"at 25 Hz, odometry of 5 mm and 0.17 deg per square root of a metre, IMU; {MOMENTS} moments of a "
        f"lap for each seed, at {', '.join(map(str, sorted(SPEEDS_MPS)))} m/s; people and trains are "
        f"{', '.join(f'{100 * share:.0f}' for share in sorted(SHARES))} % of the returns. Errors are against "
        f"the map before the scene. Beyond: more than {SIGMAS:.0f} sigma and {WITHIN_M} m off. Needless: "
        f"`degraded` or `lost` within both; still: of that, before and after the scene. Right: within "
        f"{RIGHT_M} m from then on. Ghosts: cells shown occupied that are not without the scene.",
        [
            row
            for scene, of in groupby(verdicts, itemgetter(0))
            for row in rows(scene, [v for key in of for v in verdicts[key]])
        ],
        [table(verdicts)],
    )


def rows(scene: str, of: Sequence[Verdict]) -> list[Row]:
    """What has a bound, over all worlds. Where the sources that are left are good, so has the pose."""
    worst = partial(Row, by_worst=True)
    made = [
        worst(f"{scene}: `ok` and {WRONG_M} m off", [v.ok_off for v in of], "scans", at_most=0.0),
        worst(
            f"{scene}: needless before and after", [v.needless_still_percent for v in of], "%", at_most=1.0
        ),
    ]
    if scene in RECORDINGS:
        made.append(worst(f"{scene}: off at the end", [v.end_m for v in of], "m", at_most=RIGHT_M))
    elif SCENES[scene].is_bound:
        made += [
            worst(
                f"{scene}: off after it, beyond 2 % of its distance",
                [v.over_m for v in of],
                "m",
                at_most=RIGHT_M,
            ),
            worst(f"{scene}: right after", [v.right_after_s for v in of], "s", at_most=2.0),
            worst(f"{scene}: ghosts", [v.ghosts for v in of], "cells", at_most=20.0),
        ]
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.accuracy.scenes", description=__doc__)
    add = partial(parser.add_argument, action="append", default=[])
    add("--scene", choices=[*SCENES, *RECORDINGS], help="all that are simulated; or a given recording")
    add("--world", choices=PLACES, help="all")
    add("--seed", type=int, help="11")
    add("--moment", type=float, help="where on the lap the drive begins, 0 to 1; 0")
    add("--speed", type=float, help="m/s; 1")
    add("--share", type=float, help="of the returns; 0.33")
    parser.add_argument("--turns", type=int, help="so many moments a seed, speeds and shares take turns")
    parser.add_argument("--for-s", type=float, help="how long it lasts; as the scene has it")
    parser.add_argument("--no-imu", action="store_true")
    parser.add_argument("--profile", default="corridor")
    parser.add_argument("--trace", action="store_true", help="a line for each second")
    parsed = parser.parse_args(arguments)
    import_methods()
    warm_up()
    verdicts: dict[tuple[str, str], list[Verdict]] = {}
    for name in [name for name in parsed.scene if name in RECORDINGS]:
        verdicts[name, "given"] = [given(name, parsed.profile, parsed.trace)]
    simulated = [name for name in parsed.scene if name in SCENES] if parsed.scene else SCENES
    for scene, world in product(simulated, parsed.world or PLACES):
        seeds = parsed.seed or (11,)
        if parsed.turns is not None:
            cases = cases_of(scene, world, seeds, parsed.turns)
        else:
            others = (seeds, parsed.moment or (0.0,), parsed.speed or (1.0,), parsed.share or (0.33,))
            cases = [Case(scene, world, *of) for of in product(*others)]
        for case in cases:
            of = replace(case, for_s=parsed.for_s, has_imu=not parsed.no_imu)
            verdicts.setdefault((scene, world), []).append(shown(of, parsed.profile, parsed.trace))
    print(table(verdicts))
    return 0


def shown(case: Case, profile: str, is_traced: bool) -> Verdict:
    """Run one and print it."""
    of = staged(case)
    began_s = time.process_time()
    done = mapped(of, profile)
    took_s = time.process_time() - began_s
    if is_traced:
        truth = [of.made.truth[output.stamp_ns] for output in done.outputs]
        print(f"{case}: from {of.from_ns * 1e-9:.2f} to {of.to_ns * 1e-9:.2f} s")
        print("\n".join(trace(done.outputs, truth, of.from_ns)))
    verdict = verdict_of(of, done, profile)
    print(f"{case} returns={of.returns:.2f} {verdict.line()} mapping_s={took_s:.1f}", flush=True)
    gc.collect()
    return verdict


def given(name: str, profile: str, is_traced: bool) -> Verdict:
    """Run a given recording and print it."""
    of = replayed(name, profile)
    if is_traced:
        print("\n".join(trace(of.outputs, of.truth, of.from_ns)))
    print(f"{name} {of.verdict.line()}", flush=True)
    return of.verdict


if __name__ == "__main__":
    sys.exit(main())
