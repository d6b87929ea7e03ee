"""Where tasks run: one after the other here, in processes of this machine, or on a Dask cluster.

Each yields (index of the task, its outcome) as tasks end. A process that dies costs its own task alone,
which is tried MAX_TRIES times in all, then reported with the last lines of its log.
"""

import logging
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

from service.errors import CorridorError, StorageError, UsageError
from service.extras import optional
from service.interruption import before_ending, children_do_not_hear, end_with_parent
from service.offline.cluster.tasks import AnyTask, Done, logged, run

log = logging.getLogger(__name__)

MAX_TRIES = 3
LOG_LINES = 10  # of a task whose process died
CONNECT_S = 30.0  # for a scheduler to answer, at first and after it was lost
LOCAL, SLURM = "local:", "slurm:"  # and how many workers
ADDRESSES = ("tcp://", "tls://")
Ended = Generator[tuple[int, Done], None, None]
Engine = Callable[[Sequence[AnyTask]], Ended]


def in_turn(tasks: Sequence[AnyTask]) -> Ended:
    """Run the tasks one after the other in this process."""
    for k, task in enumerate(tasks):
        yield k, run(task)


class Processes:
    """So many at a time, each in a process of this machine. Needs no extra. Used by `with`."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> "Processes":
        return self

    def __exit__(self, *exception: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def __call__(self, tasks: Sequence[AnyTask]) -> Ended:
        with TemporaryDirectory(prefix="corridor-", ignore_cleanup_errors=True) as folder:
            logs = [Path(folder) / f"{k}.log" for k in range(len(tasks))]
            yield from self._run(tasks, logs)

    def _run(self, tasks: Sequence[AnyTask], logs: Sequence[Path]) -> Ended:
        left, deaths = dict(enumerate(tasks)), Counter[int]()
        while left:
            # After a death those that had begun go on one by one, which shows whose fault it was.
            suspects = [k for k in left if deaths[k]][:1]
            cut_off = []
            for k, done in self._round({k: left[k] for k in suspects or left}, logs):
                if done is None:
                    cut_off.append(k)
                else:
                    del left[k]
                    yield k, done
            for k in [k for k in cut_off if logs[k].exists()] or cut_off:
                deaths[k] += 1
                if deaths[k] == MAX_TRIES:
                    del left[k]
                    yield k, _lost(tasks[k], _lines_of(logs[k]))

    def _round(self, tasks: dict[int, AnyTask], logs: Sequence[Path]) -> Iterator[tuple[int, Done | None]]:
        """None: not done, for a process of the pool died."""
        if self._pool is None:
            # spawn: a forked child would inherit locks of numba's and of threads that it does not have
            self._pool = ProcessPoolExecutor(
                min(self._jobs, len(logs)), get_context("spawn"), initializer=end_with_parent
            )
        with children_do_not_hear():
            futures = {self._pool.submit(_run_in_pool, task, logs[k]): k for k, task in tasks.items()}
        try:
            for future in as_completed(futures):
                try:
                    yield futures[future], future.result()
                except BrokenProcessPool:
                    self._pool = None
                    yield futures[future], None
        finally:  # a caller that takes no more of them goes on with others
            for future in futures:
                future.cancel()


def _lines_of(log_file: Path) -> list[str]:
    if not log_file.exists():
        return []
    return log_file.read_text(encoding="utf-8", errors="replace").splitlines()


def _run_in_pool(task: AnyTask, log_file: Path) -> Done:
    with (
        log_file.open("a", encoding="utf-8", buffering=1) as file,
        logged(lambda line: file.write(f"{line}\n")),
    ):
        return run(task)


class Cluster:
    """A Dask cluster: `local:N` processes of this machine, `slurm:N` jobs by dask-jobqueue, or the address of
    a scheduler. Used by `with`.

    Raises UsageError where it is wanted in another form, CorridorError without the extra.
    """

    def __init__(self, wanted: str) -> None:
        self._wanted = wanted
        kind = next((kind for kind in (LOCAL, SLURM) if wanted.startswith(kind)), None)
        number = wanted.partition(":")[2]
        if not (number.isdecimal() and int(number)) if kind else not wanted.startswith(ADDRESSES):
            raise UsageError(
                f"--cluster {wanted}: expected local:N (processes of this machine), slurm:N (jobs) or the "
                "address of a Dask scheduler, tcp://HOST:8786 or tls://HOST:8786"
            )
        self._dask: Any = optional("dask", "cluster", f"--cluster {wanted}")
        self._distributed: Any = optional("dask.distributed", "cluster", f"--cluster {wanted}")
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # of a lost scheduler: pages of traces
        self._stack = ExitStack()
        self._address: Any = wanted  # of the scheduler, or the cluster that has one
        self._is_shown = False
        if kind is not None:
            self._address = self._stack.enter_context(
                closing(self._local(int(number)) if kind == LOCAL else self._slurm(int(number)))
            )

    def __enter__(self) -> "Cluster":
        return self

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def __call__(self, tasks: Sequence[AnyTask]) -> Ended:
        """Run the tasks; after a loss of the scheduler open ones are sent again once it is back."""
        left = dict(enumerate(tasks))
        while left:
            with self._client() as client:
                for k, done in self._round(client, left):
                    del left[k]
                    yield k, done
            if left:
                log.warning("%s: the scheduler was lost; %d tasks go to it again", self._wanted, len(left))

    def _round(self, client: Any, left: dict[int, AnyTask]) -> Ended:
        """Outcomes of tasks that end before the scheduler is lost."""
        batch = uuid4().hex
        futures = {
            client.submit(_run_on_worker, f"{batch}-{k}", task, key=f"corridor-{k}-{batch}", pure=False): k
            for k, task in left.items()
        }
        for future in self._distributed.as_completed(list(futures), loop=client.loop):
            k = futures[future]
            if future.status == "finished":
                yield k, future.result()
            elif future.status == "error":
                error = future.exception()
                if not isinstance(error, self._distributed.KilledWorker):
                    raise CorridorError(f"{left[k].name}: {error!r} of Dask") from error
                yield k, _lost(left[k], [str(line) for _, line in client.get_events(f"{batch}-{k}")])

    @contextmanager
    def _client(self) -> Iterator[Any]:
        try:
            client = self._distributed.Client(self._address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError) as error:
            raise StorageError(
                f"no Dask scheduler answers at {self._wanted} within {CONNECT_S:.0f} s ({error}); what is "
                "done is kept: the same command goes on from there"
            ) from error
        with client:
            if not self._is_shown:
                log.info("Dask's dashboard: %s", client.dashboard_link)
                self._is_shown = True
                threads = {worker["nthreads"] for worker in client.scheduler_info()["workers"].values()}
                if threads - {1}:
                    log.warning("workers map several sessions at a time; start them with --nthreads 1")
            yield client

    def _local(self, workers: int) -> Any:
        folder = TemporaryDirectory(prefix="corridor-dask-")
        self._stack.enter_context(folder)
        before_ending(folder.cleanup)
        settings = {
            "distributed.worker.daemon": False,  # a daemon could not compile kernels on several cores
            "distributed.scheduler.allowed-failures": MAX_TRIES - 1,
            "distributed.scheduler.worker-saturation": 1.0,  # no task waits at a worker, to die with it
        }
        with self._dask.config.set(settings), children_do_not_hear():
            return self._distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:8787",
                local_directory=folder.name,
            )

    def _slurm(self, jobs: int) -> Any:
        jobqueue = optional("dask_jobqueue", "cluster", f"--cluster {self._wanted}")
        try:
            cluster = jobqueue.SLURMCluster(processes=1)
        except (ValueError, TypeError) as error:
            raise UsageError(
                f"--cluster {self._wanted}: {error}; set cores: 1 and memory in the section "
                "jobqueue.slurm of ~/.config/dask/jobqueue.yaml"
            ) from error
        cluster.scale(jobs=jobs)
        return cluster


def _run_on_worker(topic: str, task: AnyTask) -> Done:
    """Its log goes to the scheduler, where it outlives the worker."""
    worker: Any = optional("dask.distributed", "cluster", "a worker").get_worker()
    worker.log_event(topic, f"{time.strftime('%H:%M:%S')} begins on {worker.address}")
    with logged(lambda line: worker.log_event(topic, line)):
        return run(task)


def _lost(task: AnyTask, lines: Sequence[str]) -> Done:
    words = "\n  ".join(lines[-LOG_LINES:]) or "nothing"
    return Done(
        CorridorError(
            f"{task.name}: the process that worked on it died, each of {MAX_TRIES} times; is its memory "
            f"enough? The last of its log:\n  {words}"
        ),
        {},
    )
