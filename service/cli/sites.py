"""site build: one map of all drives of a site."""

import argparse

from service.archive import path_or_url
from service.cli.console import print_result, print_table, progress
from service.cli.recordings import choice_of
from service.cli.sessions import engine_of
from service.compile.cache import ensure_cache_dir


def site(parsed: argparse.Namespace) -> int:
    ensure_cache_dir()
    from service.offline.replay.setup import ReplayOptions
    from service.offline.site.build import site_build, site_table, summary_of

    options = ReplayOptions(config=parsed.config, choice=choice_of(parsed))
    paths = [path_or_url(one) for one in parsed.sessions]
    with engine_of(parsed) as engine, progress("site build") as shown:
        report = site_build(paths, options, parsed.out, engine, shown, parsed.join)
    if parsed.json:
        print_result(report, as_json=True)
        return 0
    print_table(site_table(report))
    for name, why in report["left_out"].items():
        print(f"left out: {name}: {why}")
    for warning in report["warnings"]:
        print(f"warning: {warning}")
    print(summary_of(report))
    return 0
