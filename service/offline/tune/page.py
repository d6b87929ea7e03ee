"""What a search found, as a patch for a config and as one HTML page."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drivers.counted import counted
from service.extras import optional
from service.offline.report.charts import COLUMNS, LogScale, canvas, row
from service.offline.report.markup import Markup, joined, tag
from service.offline.report.page import html_page, section, table
from service.offline.tune.search import COST_MS, Outcome
from service.offline.tune.space import section_of
from service.offline.writing import complete_files
from service.version import VERSION

PAGE_FILE, PATCH_FILE = "tune.html", "patch.yaml"
MIN_TRIALS = 4  # that came to their end, before importances mean anything


def write_outcome(outcome: Outcome, profile: str, out: Path) -> None:
    """tune.html and patch.yaml. Raises StorageError."""
    for name, text in ((PAGE_FILE, page_of(outcome, profile)), (PATCH_FILE, patch_of(outcome, profile))):
        with complete_files(out / name) as path:
            path.write_text(text, encoding="utf-8", errors="backslashreplace")


def patch_of(outcome: Outcome, profile: str) -> str:
    """The mapping section that has the best values, to be put into a config."""
    changed = {name: value for name, value in outcome.best.items() if value != outcome.present[name]}
    found = section_of([one for one in outcome.parameters if one.name in changed], changed)
    lines = [f"# {line}" for line in verdict(outcome)]
    section_text = yaml.safe_dump({"mapping": {"profile": profile, **found}}, sort_keys=False)
    return "\n".join([*lines, section_text])


def verdict(outcome: Outcome) -> list[str]:
    """Costs before and after, of the searched and of the validation sessions; a line each."""
    truth = any(drive.truth is not None for drive in outcome.drives)
    what = "error against the truth, m" if truth else "cost by the results themselves"
    lines = []
    for is_held_out, words in ((False, "searched"), (True, "held-out")):
        if (costs := outcome.costs(is_held_out)) is not None:
            drives = counted(sum(one.is_held_out == is_held_out for one in outcome.drives), "session")
            lines.append(f"{what}: {costs[0]:.4g} -> {costs[1]:.4g} on the {words} ({drives})")
    searched, held_out = outcome.costs(False), outcome.costs(True)
    if not truth and not any(of[0].parts.get("pass_offset_m", 1.0) for of in outcome.measured.values()):
        lines.append(
            "no session comes back to a wall 5 m of path or more later, so errors of the pose do not show: "
            "give sessions that do, or --truth"
        )
    if searched is not None and searched[1] >= searched[0]:
        lines.append("nothing that was tried is better than the present values: keep them")
    if held_out is None:
        lines.append("no session was held out: whether it helps on other drives is not known")
    elif held_out[1] > held_out[0]:
        lines.append("the held-out sessions became worse: do not take these values; give more sessions")
    return lines


def page_of(outcome: Outcome, profile: str) -> str:
    complete = [trial for trial in outcome.study.trials if trial.state.name == "COMPLETE"]
    pruned = sum(trial.state.name == "PRUNED" for trial in outcome.study.trials)
    importance = importances(outcome)
    costs = [trial.value for trial in complete]
    numbers = [trial.number + 1 for trial in complete]
    times = [trial.user_attrs[COST_MS] for trial in complete]
    slices = [
        _scatter(one.name, [trial.params[one.name] for trial in complete], costs, one.low, one.high)
        for one in outcome.parameters
    ]
    history = _scatter("trial", numbers, costs, 1, len(outcome.study.trials), is_log=False)
    trade_off = _scatter("CPU time a scan, ms", times, costs, min(times), max(times), is_log=False)
    note = (
        f"{counted(len(complete), 'trial')} to the end, {pruned} ended early, worse than the median. "
        "The best is filled."
    )
    title = f"Settings of the profile {profile}"
    parts = [
        tag("header", tag("h1", title), [tag("p", line, class_="verdict") for line in verdict(outcome)]),
        section("Values", _values(outcome, importance)),
        section("Trials", tag("div", history, class_="timeline"), tag("p", note, class_="note")),
        section("Importances", _bars(importance), tag("p", IMPORTANCE_NOTE, class_="note")),
        section("Cost by value", tag("div", slices, class_="timeline")),
        section("Trade-off", tag("div", trade_off, class_="timeline")),
        section("Sessions", _sessions(outcome)),
        tag("footer", tag("p", f"Made by corridor tune, {VERSION}, with Optuna.")),
    ]
    return html_page(title, parts)


IMPORTANCE_NOTE = (
    "Share of the difference between the best tenth of the trials and the others, by parameter: PED-ANOVA, "
    "Watanabe, Bansal, Hutter, IJCAI 2023. Of few trials it is rough."
)


def importances(outcome: Outcome) -> dict[str, float]:
    """Importance of each parameter, 1 in sum; {} where there are too few trials."""
    optuna = optional("optuna", "tune", "importances")
    complete = outcome.study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    if len(complete) < MIN_TRIALS or len({trial.value for trial in complete}) < 2:
        return {}
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    found = optuna.importance.get_param_importances(outcome.study, evaluator=evaluator)
    return {name: float(share) for name, share in found.items()}


def _values(outcome: Outcome, importance: dict[str, float]) -> Markup | None:
    heads = ("setting", "present", "best", "searched from", "to", "importance")
    return table(
        heads,
        [
            (
                one.name,
                f"{one.present:g}",
                f"{outcome.best[one.name]:g}",
                f"{one.low:g}",
                f"{one.high:g}",
                f"{100 * importance[one.name]:.0f} %" if one.name in importance else "",
            )
            for one in outcome.parameters
        ],
    )


def _sessions(outcome: Outcome) -> Markup | None:
    rows: list[Sequence[object]] = []
    for drive in outcome.drives:
        before, after = outcome.measured[drive.name]
        for name, value in before.parts.items():
            of = "held out" if drive.is_held_out else "searched"
            rows.append((drive.session[0].name, of, name, f"{value:.4g}", f"{after.parts[name]:.4g}"))
    return table(("session", "part", "measure", "present", "best"), rows)


def _bars(shares: dict[str, float]) -> Markup | None:
    if not shares:
        return None
    bars = [
        row(
            name,
            canvas(tag("rect", class_="frames", x=0, y=0, width=f"{share * COLUMNS:.1f}", height=100)),
            "strip",
            note=f"{100 * share:.0f} %",
        )
        for name, share in shares.items()
    ]
    return tag("div", bars, class_="timeline")


def _scatter(
    name: str, xs: Sequence[float], ys: Sequence[float], low: float, high: float, is_log: bool = True
) -> Markup:
    """The cost of each trial over xs, logarithmic; the least one is filled, the others hollow."""
    scale = LogScale.of(np.array(ys), min(ys), "")
    along = math.log if is_log else float
    width = along(high) - along(low)
    dots: list[Any] = []
    for x, y, top in zip(xs, ys, scale.y(np.array(ys)), strict=True):
        left = 100.0 * ((along(x) - along(low)) / width if width else 0.5)
        dots.append(
            tag(
                "i",
                class_="dot" if y == min(ys) else "dot refused",
                style=f"left:{left:.2f}%;top:{top:.2f}%",
                title=f"{name} {x:g}: cost {y:.4g}",
            )
        )
    grid = canvas(tag("path", class_="grid", d=scale.grid()))
    ends = [tag("span", f"{low:.3g}", style="left:0%"), tag("span", f"{high:.3g}", style="left:97%")]
    axis = tag("div", tag("div", ends, class_="ticks"), class_="row axis")
    return joined([row(name, [grid, scale.words(), dots], note="cost"), axis])
