# What a user and a pull request need. `make demo` is the first command to try.
.DEFAULT_GOAL := help
SHELL := /bin/sh

# The first interpreter between 3.11 and 3.13 that really runs; override with PYTHON=...
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
export CORRIDOR_SHARED ?= $(abspath ../shared)
# One thread a process: the mapper is single-threaded, and BLAS pools only steal its core.
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: help venv demo test check bench papers chaos interop soak clean

help: ## this list
	@awk -F':.*## ' '/^[a-z]+:.*## /{printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

venv: $(STAMP) ## set up .venv; nothing to do when nothing changed

$(STAMP): pyproject.toml
	@test -n "$(PYTHON)" || { echo "corridor needs Python 3.11, 3.12 or 3.13 with venv; none found. On Debian: apt install python3-venv"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "$(PYTHON) has no venv module. On Debian and Ubuntu: apt install python3-venv"; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	$(BIN)/corridor warmup # so that the first start and the first test find every kernel compiled
	@touch $(STAMP)

demo: venv ## fake devices, drivers, mapping, Zenoh and recording on this machine, until Ctrl-C
	$(BIN)/corridor demo $(DEMO_ARGS)

# Three groups side by side. What computes gives way to what talks to devices and clocks in real time.
COMPUTING := tests/accuracy $(addprefix tests/service/,fusion geometry kernels mapper mapstore offline recording)
TALKING := $(addprefix tests/,chaos drivers simulators)
PYTEST = $(BIN)/python -m pytest -q -m "not soak and not bench"

test: venv ## every test that needs no root
	$(BIN)/corridor warmup # on both cores; a test compiles on one
ifdef TEST_ARGS
	$(PYTEST) $(TEST_ARGS)
else
	@mkdir -p build; \
	nice $(PYTEST) -p no:cacheprovider $(COMPUTING) > build/computing.log 2>&1 & computing=$$!; \
	nice $(PYTEST) -p no:cacheprovider $(TALKING) > build/talking.log 2>&1 & talking=$$!; \
	trap 'kill $$computing $$talking' INT TERM; \
	$(PYTEST) $(addprefix --ignore=,$(COMPUTING) $(TALKING)); waited=$$?; \
	wait $$talking; talked=$$?; cat build/talking.log; \
	wait $$computing; computed=$$?; cat build/computing.log; exit $$((waited + talked + computed))
endif

check: venv ## ruff, mypy --strict, import-linter
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: venv ## the benchmarks: a table, and bench.json
	$(BIN)/python -m tests.bench $(BENCH_ARGS)

papers: venv ## the papers' experiments: tables and pictures in docs/papers
	$(BIN)/python -m tests.papers $(PAPERS_ARGS)

chaos: venv ## every driver through every fault, then the whole machine: a table
	$(BIN)/python -m tests.chaos $(CHAOS_ARGS)

interop: venv ## third-party programs, each in a venv of its own, against ours: a table
	$(BIN)/python -m tests.interop $(INTEROP_ARGS)

soak: venv ## the long checks
	$(BIN)/python -m pytest -q -m soak $(TEST_ARGS)

clean: ## remove what make made
	rm -rf $(VENV) .venv-interop build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache out bench.json
