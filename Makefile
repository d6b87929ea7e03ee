# What a user and a pull request need. `make demo` is the first command to try.
.DEFAULT_GOAL := help
SHELL := /bin/sh

# The first interpreter between 3.11 and 3.13 that really runs; override with PYTHON=...
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null && echo $$p && break; done)
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
VENV_MB := 1600
AXE := build/node_modules/axe-core/axe.min.js
export CORRIDOR_SHARED ?= $(abspath ../shared)
# One thread a process: the mapper is single-threaded, and BLAS pools only steal its core.
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: help venv demo test check ci axe bench papers chaos interop soak lock wheel deb release clean

help: ## this list
	@awk -F':.*## ' '/^[a-z]+:.*## /{printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# With LOCKED=1 exactly the versions of .ci/lock.txt, checked by their hashes, uv's own too; else the newest allowed.
ifdef LOCKED
INSTALL := sed -n '/^uv==/,/[^\\]$$/p' .ci/lock.txt | \
	$(BIN)/python -m pip install --progress-bar off --disable-pip-version-check --require-hashes -r /dev/stdin && \
	$(BIN)/uv pip install --python $(BIN)/python --constraints .ci/lock.txt --editable '.[dev]'
else
INSTALL := $(BIN)/python -m pip install --progress-bar off --disable-pip-version-check --editable '.[dev]'
endif

venv: $(STAMP) ## set up .venv; nothing to do when nothing changed

# pip prints nothing while it unpacks: each 5 s its last step and the size of the venv are printed.
$(STAMP): pyproject.toml
	@test -n "$(PYTHON)" || { echo "corridor needs Python 3.11, 3.12 or 3.13 with venv; none found. On Debian: apt install python3-venv"; exit 1; }
	@echo "1/3 $(VENV): a Python environment by $(PYTHON), some seconds"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "$(PYTHON) has no venv module. On Debian and Ubuntu: apt install python3-venv"; exit 1; }
	@echo "2/3 packages: some $(VENV_MB) MB on disk, a quarter of it to download; one to five minutes"
	@{ $(INSTALL); } > $(VENV)/pip.log 2>&1 & pip=$$!; \
	trap 'kill $$pip' INT TERM; seconds=0; \
	while kill -0 $$pip 2>/dev/null; do sleep 1; seconds=$$((seconds + 1)); \
		test $$((seconds % 5)) -ne 0 || echo "    $$seconds s, $$(du -sm $(VENV) | cut -f1) MB:" \
			"$$(grep -E 'Collecting|Downloading|Installing' $(VENV)/pip.log | tail -n 1 | cut -c 1-70)"; done; \
	wait $$pip || { tail -n 30 $(VENV)/pip.log; echo "pip failed; all of its words: $(VENV)/pip.log"; exit 1; }
	@echo "3/3 kernels: compiled once for this processor, half a minute to two minutes, five where others take the cores"
	@$(BIN)/corridor warmup # so that the first start and the first test find every kernel compiled
	@$(BIN)/corridor check --schema > config/schema/config.json # by which editors complete the examples
	@touch $(STAMP)

demo: venv ## fake devices, drivers, mapping, Zenoh and recording on this machine, until Ctrl-C
	$(BIN)/corridor demo $(DEMO_ARGS)

test: venv ## every test that needs no root
ifdef TEST_ARGS
	$(BIN)/python -m pytest -q -rs -m "not soak and not bench" $(TEST_ARGS)
else
	@$(BIN)/python -m tests.groups
endif

check: venv ## ruff, mypy --strict, import-linter
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@echo "mypy: half a minute where nothing is cached"
	$(BIN)/mypy
	MYPYPATH=service/python $(BIN)/mypy tests/system/typed_program.py # of a user
	$(BIN)/lint-imports

ci: ## what a pull request must pass: check, test, and test with Python 3.13 where that is installed
	.ci/run

axe: $(AXE) ## axe-core by npm, with which the browser tests judge accessibility; skipped without it

$(AXE):
	npm install --prefix build --no-audit --no-fund --fetch-retries 1 --fetch-timeout 20000 axe-core@4.14.1

bench: venv ## the benchmarks: a table, and bench.json
	$(BIN)/python -m tests.bench $(BENCH_ARGS)

papers: venv ## the papers' experiments: tables and pictures in build/papers
	$(BIN)/python -m tests.papers $(PAPERS_ARGS)

chaos: venv ## faults of wires, devices, processes, disks and clocks, judged against the truth: a table
	$(BIN)/python -m tests.chaos $(CHAOS_ARGS)

interop: venv ## third-party programs, each in a venv of its own, against ours: a table
	$(BIN)/python -m tests.interop $(INTEROP_ARGS)

wheel: venv ## the wheel, in build/
	rm -rf build/lib build/bdist.* build/corridor-*.whl
	$(BIN)/python -m pip --disable-pip-version-check wheel --quiet --no-deps --no-build-isolation --wheel-dir build .

deb: wheel ## a Debian package for this Debian or Ubuntu, in build/
	$(BIN)/python systemd/package/build_deb.py build/corridor-*.whl --out build

lock: venv ## .ci/lock.txt: the newest allowed versions of all packages, with their hashes
	$(BIN)/uv pip compile pyproject.toml --quiet --upgrade --all-extras --universal --generate-hashes \
		--no-annotate --no-header --output-file .ci/lock.txt

release: venv ## wheel and sdist of the commit, the same bytes each time, SBOM, licences, sums, in build/release
	.ci/release $(BIN)

soak: venv ## the long checks
	$(BIN)/python -m pytest -q -m soak $(TEST_ARGS)
	$(BIN)/python -m pytest -q -m hypothesis --hypothesis-profile=thorough $(TEST_ARGS)

clean: ## remove what make made
	rm -rf $(VENV) .venv-3.13 .venv-interop build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache out bench.json config/schema/config.json
