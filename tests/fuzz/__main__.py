"""Search for bytes that a reader fails at, guided by coverage: python -m tests.fuzz NAME --seconds 60."""

import argparse
import logging
import sys
import tempfile
from pathlib import Path

import atheris

MAX_BYTES = 40_000
MAX_MB = 2500
SLOW_S = 20  # one input that takes longer is a find, too


def main() -> None:
    with atheris.instrument_imports(include=["service", "drivers"]):
        from tests.fuzz.targets import TARGETS
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=list(TARGETS))
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--found", type=Path, default=Path("build"), help="folder of the inputs that failed")
    parsed = parser.parse_args()
    target = TARGETS[parsed.name]
    logging.disable(logging.CRITICAL)
    parsed.found.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as corpus:
        for number, seed in enumerate(target.seeds()):
            (Path(corpus) / f"seed-{number}").write_bytes(seed)
        options = [f"-max_total_time={round(parsed.seconds)}", f"-max_len={MAX_BYTES}", f"-timeout={SLOW_S}"]
        options += [f"-rss_limit_mb={MAX_MB}", f"-artifact_prefix={parsed.found}/{parsed.name}-"]
        atheris.Setup([sys.argv[0], corpus, *options, "-verbosity=0", "-print_final_stats=1"], target)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
