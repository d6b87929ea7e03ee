"""`corridor tune`: settings of a profile by Optuna, over sessions as tasks.

Optuna: Akiba, Sano, Yanase, Ohta, Koyama, KDD 2019. Trials follow one another, each by all that were before;
the sessions of one trial run beside each other. So a search repeats itself, on whatever engine, and goes on
where it was stopped.
"""

import hashlib
import json
import math
import shutil
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from service.archive import fingerprint
from service.errors import ConfigError, CorridorError, InputError, StorageError, UsageError
from service.extras import optional
from service.offline.cluster.engines import Engine
from service.offline.cluster.session_task import new_tasks
from service.offline.cluster.tasks import program_digest
from service.offline.replay.setup import ReplayOptions
from service.offline.tune.measures import Measured, measure
from service.offline.tune.space import Parameter, section_of

STUDY_FILE = "study.db"
TRIALS = "trials"  # folder of the results of the trial at work
PRUNE_AFTER = 5  # trials that always come to their end: the first ones show what is usual
ABOUT, COST_MS, REFUSED = "about", "scan_cpu_ms", "refused"  # attributes of a study, of a trial
# Share of the trials, None of other phases; the phase; as text
Progress = Callable[[float | None, str, str], None]


@dataclass(frozen=True, slots=True)
class Drive:
    """truth      None: it is measured by itself
    is_held_out   takes no part in the search
    """

    session: tuple[Path, ...]
    truth: Path | None
    is_held_out: bool

    @property
    def name(self) -> str:
        return str(self.session[0])


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a search.

    present, best   values by name of the parameter
    measured        drive -> with the present and with the best values
    """

    study: Any
    parameters: Sequence[Parameter]
    drives: Sequence[Drive]
    best: dict[str, float]
    measured: dict[str, tuple[Measured, Measured]]

    @property
    def present(self) -> dict[str, float]:
        return {parameter.name: parameter.present for parameter in self.parameters}

    def costs(self, is_held_out: bool) -> tuple[float, float] | None:
        """Geometric means, present and best; None where there are no such drives."""
        pairs = [self.measured[one.name] for one in self.drives if one.is_held_out == is_held_out]
        if not pairs:
            return None
        before, after = zip(*pairs, strict=True)
        return geometric_mean(before), geometric_mean(after)


def geometric_mean(measured: Sequence[Measured]) -> float:
    """Geometric mean of the costs: a drive whose errors are ten times larger counts as much as any other."""
    return math.exp(sum(math.log(max(one.cost, 1e-9)) for one in measured) / len(measured))


def tune(
    drives: Sequence[Drive],
    options: ReplayOptions,
    parameters: Sequence[Parameter],
    out: Path,
    trials: int,
    seed: int,
    engine: Engine,
    progress: Progress,
) -> Outcome:
    """Search until there are `trials` trials, those of an earlier call with the same arguments included; then
    replay all drives with the present and with the best values, to out/present and out/best.

    Raises UsageError where `out` has a search of other sessions or settings, CorridorError where a session
    cannot be mapped with the present settings.
    """
    optuna = optional("optuna", "tune", "corridor tune")
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    run = _Runs(drives, options, parameters, out, engine)
    about = _about(drives, options, parameters, seed)
    study = _open_study(optuna, out, about)  # before out/present, which another search may have filled
    progress(None, "replays with the present settings", "")
    present = run.all("present", {one.name: one.present for one in parameters}, drives)
    _begin_search(optuna, study, about, parameters)
    progress(len(_ended(study)) / trials, "trials", "")
    while (done := len(_ended(study))) < trials:
        # Again for each trial, of its number: a search that goes on draws what one in a single run draws.
        study.sampler = optuna.samplers.TPESampler(seed=seed + done, multivariate=True)
        trial = study.ask()
        state, cost = _try(optuna, trial, run)
        study.tell(trial, cost, state=state)
        best = study.best_value if _complete(study) else math.nan
        progress((done + 1) / trials, "trials", f", {done + 1} of {trials} trials, best {best:.4g}")
    if not _complete(study):
        raise CorridorError("no trial came to its end: every setting tried was refused; narrow the ranges")
    best = {one.name: one.tried(study.best_params[one.name]) for one in parameters}
    shutil.rmtree(out / TRIALS, ignore_errors=True)
    progress(None, "replays with the best settings", "")
    after = run.all("best", best, drives)
    measured = {one.name: (present[one.name], after[one.name]) for one in drives}
    return Outcome(study, parameters, drives, best, measured)


def _try(optuna: Any, trial: Any, run: "_Runs") -> tuple[Any, float | None]:
    """State and cost of a trial; it ends early where it is worse than the median so far."""
    states = optuna.trial.TrialState
    values = {one.name: one.suggested(trial) for one in run.parameters}
    folder = f"{TRIALS}/{hashlib.sha256(json.dumps(values).encode()).hexdigest()[:12]}"
    measured: list[Measured] = []
    times: list[float] = []
    searched = [one for one in run.drives if not one.is_held_out]
    try:
        with closing(run.each(folder, values, searched)) as ended:
            for step, (_, one, summary) in enumerate(ended):
                measured.append(one)
                times.append(summary["scan_cpu_ms"]["p50"])
                trial.report(geometric_mean(measured), step)
                if trial.should_prune():
                    return states.PRUNED, None
    except (ConfigError, InputError) as error:
        trial.set_user_attr(REFUSED, str(error))
        return states.FAIL, None
    finally:
        shutil.rmtree(run.out / folder, ignore_errors=True)
    trial.set_user_attr(COST_MS, sum(times) / len(times))
    return states.COMPLETE, geometric_mean(measured)


class _Runs:
    """Drives with other values, as tasks; a result that is there already is not made again."""

    def __init__(
        self,
        drives: Sequence[Drive],
        options: ReplayOptions,
        parameters: Sequence[Parameter],
        out: Path,
        engine: Engine,
    ) -> None:
        self.drives, self.parameters, self.out = drives, parameters, out
        self._options, self._engine = options, engine

    def all(self, folder: str, values: Mapping[str, float], drives: Sequence[Drive]) -> dict[str, Measured]:
        return {drive.name: measured for drive, measured, _ in self.each(folder, values, drives)}

    def each(
        self, folder: str, values: Mapping[str, float], drives: Sequence[Drive]
    ) -> Generator[tuple[Drive, Measured, dict[str, Any]], None, None]:
        """In the order of the drives. Raises CorridorError of the first that could not be mapped."""
        options = replace(self._options, mapping=section_of(self.parameters, values))
        folders = [self.out / folder / f"{k}_{drive.session[0].stem}" for k, drive in enumerate(drives)]
        waiting: dict[int, Any] = {}
        next_one = 0
        tasks = new_tasks([drive.session for drive in drives], options, folders)
        with closing(self._engine(tasks)) as ended:
            for k, done in ended:
                waiting[k] = done.outcome
                while next_one in waiting:
                    outcome, drive = waiting.pop(next_one), drives[next_one]
                    if isinstance(outcome, CorridorError):
                        raise outcome
                    yield drive, measure(folders[next_one], outcome, drive.truth), outcome
                    next_one += 1


def _open_study(optuna: Any, out: Path, about: str) -> Any:
    """Raises UsageError where it is another search, StorageError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        study = optuna.create_study(
            storage=optuna.storages.RDBStorage(
                f"sqlite:///{(out / STUDY_FILE).absolute()}",
                engine_kwargs={"poolclass": import_module("sqlalchemy.pool").NullPool},  # keeps no file open
            ),
            study_name="corridor",
            pruner=optuna.pruners.MedianPruner(n_startup_trials=PRUNE_AFTER),
            load_if_exists=True,
        )
    except (OSError, optuna.exceptions.StorageInternalError) as error:
        raise StorageError(f"{out / STUDY_FILE}: {error}") from error
    if study.user_attrs.get(ABOUT, about) != about:
        raise UsageError(
            f"{out} has a search of other sessions, settings, ranges or sources of corridor; name another "
            "folder by --out, or delete it"
        )
    return study


def _begin_search(optuna: Any, study: Any, about: str, parameters: Sequence[Parameter]) -> None:
    study.set_user_attr(ABOUT, about)
    for trial in study.get_trials(states=[optuna.trial.TrialState.RUNNING]):
        study.tell(trial.number, state=optuna.trial.TrialState.FAIL)  # cut off: it is evaluated once more
    waiting = study.get_trials(states=[optuna.trial.TrialState.WAITING])
    if not _ended(study) and not waiting and all(one.low <= one.present <= one.high for one in parameters):
        study.enqueue_trial({one.name: one.present for one in parameters})


def _about(
    drives: Sequence[Drive], options: ReplayOptions, parameters: Sequence[Parameter], seed: int
) -> str:
    """Digest of all that a search depends on but the recordings, which are large: those by their names."""
    files = {one.truth for one in drives} | {options.config}
    content = sorted(fingerprint(path) for path in files if path is not None)
    given = [list(map(str, drives)), str(options), list(map(str, parameters)), seed, content]
    words = [*given, program_digest()]
    return hashlib.sha256(json.dumps(words).encode()).hexdigest()


def _ended(study: Any) -> list[Any]:
    """Trials that count; not those that were cut off with the program."""
    return [
        one for one in study.trials if one.state.name in ("COMPLETE", "PRUNED") or REFUSED in one.user_attrs
    ]


def _complete(study: Any) -> list[Any]:
    return [one for one in study.trials if one.state.name == "COMPLETE"]
