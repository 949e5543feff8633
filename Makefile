# SPDX-License-Identifier: Apache-2.0
# make demo, make test: all that they need is python3 (3.11 or 3.12) with venv, and make.
PYTHON ?= python3
VENV ?= .venv
# Of make soak and make fuzz.
MINUTES ?= 3
SECONDS ?= 60
SEED ?= 1
# Tests that run for as long as they are told.
ENDLESS := test/bags/test_fuzz.py test/fuzz/test_nodes.py test/nodes/test_soak.py
BIN := $(VENV)/bin

.PHONY: demo test lint types unit long bags bench certificate fuzz faults soak audit scale reality pages clean help

help:
	@echo "make demo         set up .venv, run both nodes on the recorded bags, table and picture in out/"
	@echo "make test         lint, types and tests"
	@echo "make long         more robots, states and points of what make test has some of"
	@echo "make bags         record the bags anew (Pinocchio, PyNite)"
	@echo "make bench        side-by-side timings into docs/benchmarks.md"
	@echo "make certificate  torques and compliance against other engines, into docs/certificate*.md"
	@echo "make fuzz         every bit of a bag; messages, files and command lines at random (SECONDS, SEED)"
	@echo "make faults       the catalogue of faults row by row, into docs/faults.md"
	@echo "make soak         ten million poses, and all nodes in all weathers, in flat memory (MINUTES)"
	@echo "make audit        known vulnerabilities of what is installed"
	@echo "make scale        what sweeps cost, into docs/scale.md"
	@echo "make reality      public recordings of real machines into docs/reality.md"
	@echo "make pages        docs/parameters.md from the schemas, pictures of imports, robots and the page"
	@echo "make clean        remove .venv, out and caches"

# One stamp a set of extras, made anew when the requirements change.
$(VENV)/demo.stamp: setup.py pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[jazzy]'
	touch $@

$(VENV)/%.stamp: $(VENV)/demo.stamp
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[jazzy,$*]'
	touch $@

demo: $(VENV)/demo.stamp
	$(BIN)/python -m pkm_twin.apps.demo --bags bags --out out

# At once, as types are one process's work: the last lines are those of the tests.
test: $(VENV)/test.stamp
	$(MAKE) --no-print-directory -j 3 lint types unit

lint: $(VENV)/test.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/test.stamp
	$(BIN)/mypy

# Four at a time, as many wait for processes: a test that needs quiet waits for conditions, none for a clock.
# A file is one worker's: what its tests share is made once. Bytecode is kept, as hundreds of
# processes start.
unit: $(VENV)/test.stamp
	env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder

long: $(VENV)/test.stamp
	$(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder -m long $(ENDLESS:%=--ignore=%)

bags: $(VENV)/bags.stamp
	$(BIN)/python -m bags.recording

bench: $(VENV)/bench.stamp
	mkdir -p out
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest test/benchmarks -m benchmark_run --benchmark-disable-gc --benchmark-json=out/benchmarks.json
	$(BIN)/python -m test.benchmarks.report out/benchmarks.json docs/benchmarks.md
	OMP_NUM_THREADS=1 $(BIN)/python -m test.benchmarks.latency docs/latency.md

certificate: $(VENV)/certificate.stamp
	$(BIN)/python -m test.certificate
	$(BIN)/python -m test.machine.certificate_page

# Every bit of a bag; then at random in this process, at real nodes, and the figures.
fuzz: $(VENV)/test.stamp
	$(BIN)/python -m pytest -m long test/bags
	OMP_NUM_THREADS=1 $(BIN)/python -m test.fuzz --seconds $(SECONDS) --seed $(SEED) --out out/fuzz
	FUZZ_SECONDS=$(SECONDS) FUZZ_SEED=$(SEED) FUZZ_OUT=$(CURDIR)/out/fuzz $(BIN)/python -m pytest -m long test/fuzz
	$(BIN)/python -m test.fuzz --out out/fuzz --page

faults: $(VENV)/test.stamp
	$(BIN)/python -m test.faults

soak: $(VENV)/test.stamp
	SOAK_MINUTES=$(MINUTES) SOAK_OUT=$(CURDIR)/out $(BIN)/python -m pytest -m long test/atlas/test_run.py test/nodes/test_soak.py
	$(BIN)/python -m test.nodes.soak out

audit: $(VENV)/audit.stamp
	$(BIN)/pip-audit --skip-editable

scale: $(VENV)/test.stamp
	OMP_NUM_THREADS=1 $(BIN)/python -m test.atlas.scale docs/scale.md

reality: $(VENV)/test.stamp
	$(BIN)/python -m tools.reality docs/reality.md

pages: $(VENV)/test.stamp
	$(BIN)/python -m test.docs.parameters docs/parameters.md
	$(BIN)/python -m test.docs.engine docs/engine.md
	$(BIN)/python -m test.docs.architecture docs/architecture.png
	$(BIN)/python -m test.docs.robots docs/gallery
	$(BIN)/python -m test.docs.view docs/gallery

clean:
	rm -rf $(VENV) out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
