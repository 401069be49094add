# make demo: run the paper's Fig 9 as four ROS 2 nodes.  make test: run the tests.
# Tests start real processes in wall time: one that a halted machine has failed is run again, and
# told as rerun.  make test-all: also those that show what a shorter test shows, in further cases.
# make bench: measure everything beside its yardsticks; BENCH=--write-docs keeps the figures.
# make faults: inject every fault into a loop on an emulator; writes docs/reliability.md.
# make fuzz: give 100 000 inputs that nobody meant to all that reads; FUZZ="--inputs 2000" fewer.
# make endurance: an hour at 20 kHz, an hour of a rig: complete, replays, flat in memory.
# make walk: 10 000 random steps of a rig against what must hold; WALK="--steps 500 --seed 1".
# make identification: identify 50 stages drawn at random; DRAWS="--count 5" fewer.
# make docs: build the site into log/site.  make docs-slow: run every command of the docs;
# PAGES="docs/index.md" those of these pages.
# Each sets up what it needs first (make setup); nothing has to be sourced.

PYTHON ?= python3

.PHONY: setup demo test test-all lint docs docs-slow bench faults fuzz endurance walk identification clean

setup:
	@PYTHON=$(PYTHON) ./.ci/setup

demo: setup
	@./pea run fig9_hysteresis_10hz --mode distributed --duration 0.5

test: setup
	@./.ci/test

test-all: setup
	@./.ci/test all

lint: setup
	@./.ci/env ruff format --check .
	@./.ci/env ruff check .
	@./.ci/env mypy
	@./.ci/env lint-imports

docs: setup
	@NO_MKDOCS_2_WARNING=1 ./.ci/env python -m mkdocs build --quiet

docs-slow: setup
	@./.ci/env python tests/doc_blocks.py $(PAGES)

bench: setup
	@PYTHON=$(PYTHON) ./.ci/beside bench
	@./pea bench $(BENCH)

faults: setup
	@./.ci/env python tests/faults.py --write

fuzz: setup
	@./.ci/env python tests/fuzz/run.py $(FUZZ)

endurance: setup
	@./.ci/env python tests/endurance.py $(ENDURANCE)

walk: setup
	@./.ci/env python tests/walk.py $(WALK)

identification: setup
	@./.ci/env python tests/identification/draws.py $(DRAWS)

clean:
	rm -rf .venv .venv-bench .venv-fmu build install log
