"""run, demo: what needs devices."""

import argparse
import gc
from collections.abc import Iterator
from contextlib import contextmanager

from service.cli.console import kernel_progress, print_result
from service.cli.upkeep import config_path
from service.kernel_cache import ensure_cache_dir


@contextmanager
def no_collections() -> Iterator[None]:
    """Modules are here to stay: looking for garbage among them takes a tenth of their import."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def run(parsed: argparse.Namespace) -> int:
    with no_collections():
        from service.config import load_config, without_page

    config = load_config(config_path(parsed))  # its faults first: all else takes seconds
    ensure_cache_dir()
    with no_collections():
        from service.runtime.run import run as run_service
    if parsed.no_web:
        config = without_page(config)
    summary = run_service(config)
    if parsed.json:
        print_result(summary.as_dict(), as_json=True)
    return 0


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
    print_result(run_demo(options, kernel_progress), parsed.json)
    return 0
