"""run, demo: commands that need devices."""

import argparse
import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from service.cli.console import kernel_progress, print_result
from service.cli.status_line import status_line
from service.compile.cache import ensure_cache_dir
from service.errors import CorridorError
from service.runtime.early_mapper import EarlyMapper, mapping_section


@contextmanager
def no_collections() -> Iterator[None]:
    """Modules are here to stay: looking for garbage among them takes a tenth of their import."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def run(parsed: argparse.Namespace) -> int:
    path: Path = parsed.config
    ensure_cache_dir()
    with EarlyMapper() as early:  # it imports beside what follows
        early.tell(mapping_section(path))
        with no_collections():
            from service.config import load_config

        config = load_config(path)  # its faults first: all else takes seconds
        with no_collections():
            from service.runtime.run import run as run_service
        with status_line() as line:
            summary = run_service(config, watch=line, early=early)
    if parsed.json:
        print_result(summary.as_dict(), as_json=True)
    else:
        print(what_was_written(summary.sessions, summary.map_folder))
    if summary.failure:
        raise CorridorError(summary.failure)
    return 0


def what_was_written(sessions: Sequence[Path], map_folder: Path | None) -> str:
    """Where a run left its recordings and its map."""
    lines = [f"recording: {path}" for path in sessions] or ["recording: none"]
    return "\n".join([*lines, f"map: {map_folder}" if map_folder else "map: none, no scan was mapped"])


def demo(parsed: argparse.Namespace) -> int:
    ensure_cache_dir()
    with no_collections():
        from service.demo import DemoOptions
        from service.demo import demo as run_demo

    options = DemoOptions(
        parsed.seconds,
        parsed.world,
        parsed.profile,
        parsed.seed,
        parsed.out,
        parsed.faults,
        web=not parsed.no_web,
        port=parsed.port,
        web_port=parsed.web_port,
    )
    with status_line() as line:
        facts = run_demo(options, kernel_progress, line, line.write)
    print_result(facts, parsed.json)
    if facts["failure"]:
        raise CorridorError(facts["failure"])
    return 0
