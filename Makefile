# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
# make demo, make test: all that they need is python3 (3.11 or 3.12) with venv, and make.
PYTHON ?= python3
VENV ?= .venv
# Of make soak and make fuzz.
MINUTES ?= 3
SECONDS ?= 60
SEED ?= 1
# Tests that run for as long as they are told.
ENDLESS := test/fuzz/test_nodes.py test/nodes/test_soak.py
BIN := $(VENV)/bin
# Tests of the cores.
CORES := bags laws machine nodes validation commands/test_joint_loads.py export/test_simulators.py

.PHONY: demo test lint types unit long bags bench certificate fuzz faults soak audit scale reality states contact-table pages papers pictures animation docs coverage mutation dist sbom clean help

help:
	@echo "make demo         set up .venv, run the main nodes on the recorded bags, table and picture in out/"
	@echo "make test         lint, types and tests"
	@echo "make long         the same tests with more robots, states and points"
	@echo "make bags         record the bags again (Pinocchio, PyNite)"
	@echo "make bench        measure times, into docs/benchmarks.md"
	@echo "make certificate  cross-check torques and compliance, into docs/validation.md"
	@echo "make fuzz         random bags, messages, files and command lines (SECONDS, SEED)"
	@echo "make faults       run the tests of every row of docs/errors.md"
	@echo "make soak         ten million poses, and all nodes under load, with constant memory (MINUTES)"
	@echo "make audit        known vulnerabilities of the installed packages"
	@echo "make scale        measure the cost of workspace maps, into docs/benchmarks.md"
	@echo "make reality      compare recordings of real machines with the models, into docs/validation.md"
	@echo "make states       compare Python, exported C and Pinocchio at a million states"
	@echo "make contact-table  simulate 1,000 contacts, into docs/nodes.md (an hour)"
	@echo "make pages        write the generated pages of docs/"
	@echo "make papers       compare with the three papers, into docs/papers.md, and draw their figures"
	@echo "make pictures     draw the pictures of docs/"
	@echo "make animation    draw the moving picture of the README, in a browser"
	@echo "make docs         build the site, in out/site"
	@echo "make coverage     branches that tests reach in the cores, by folder"
	@echo "make mutation     break gate, monitors, readers and Newton's verdict, and count what tests find"
	@echo "make dist         wheel and source distribution, the same at every build, in out/dist"
	@echo "make sbom         bill of materials with licences, in out/sbom.json"
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
	$(BIN)/python -m pkm_twin.demo.run --bags bags --out out

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
	OMP_NUM_THREADS=1 $(BIN)/python -m test.benchmarks.pinocchio_c docs/export_c.md
	OMP_NUM_THREADS=1 $(BIN)/python -m test.benchmarks.kinematics_c docs/benchmarks.md
	OMP_NUM_THREADS=1 $(BIN)/python -m test.export.c_table docs/export_c.md

certificate: $(VENV)/certificate.stamp
	$(BIN)/python -m tools.certificate

# Every bit of a bag; then at random in this process, at real nodes, and the figures.
fuzz: $(VENV)/test.stamp
	$(BIN)/python -m pytest -m long test/bags
	OMP_NUM_THREADS=1 $(BIN)/python -m test.fuzz --seconds $(SECONDS) --seed $(SEED) --out out/fuzz
	FUZZ_SECONDS=$(SECONDS) FUZZ_SEED=$(SEED) FUZZ_OUT=$(CURDIR)/out/fuzz $(BIN)/python -m pytest -m long test/fuzz
	$(BIN)/python -m test.fuzz --out out/fuzz --page

faults: $(VENV)/test.stamp
	$(BIN)/python -m test.faults

soak: $(VENV)/test.stamp
	SOAK_MINUTES=$(MINUTES) SOAK_OUT=$(CURDIR)/out $(BIN)/python -m pytest -m long test/maps/test_run.py test/nodes/test_soak.py
	$(BIN)/python -m test.nodes.soak out

audit: $(VENV)/audit.stamp
	$(BIN)/pip-audit --skip-editable

scale: $(VENV)/test.stamp
	OMP_NUM_THREADS=1 $(BIN)/python -m test.maps.scale docs/benchmarks.md

reality: $(VENV)/test.stamp
	$(BIN)/python -m tools.reality docs/validation.md

# Needs g++ and the headers of Eigen.
states: $(VENV)/certificate.stamp
	OMP_NUM_THREADS=1 $(BIN)/python -m test.benchmarks.pinocchio_c 1000000

contact-table: $(VENV)/test.stamp
	OMP_NUM_THREADS=1 $(BIN)/python -m tools.contact_table docs/nodes.md

pages: $(VENV)/test.stamp
	$(BIN)/python -m tools.pages.parameters docs/parameters.md
	$(BIN)/python -m tools.pages.commands docs/commands.md
	$(BIN)/python -m tools.pages.errors docs/errors.md
	$(BIN)/python -m tools.pages.nodes docs/nodes.md docs/security/policy.xml
	$(BIN)/python -m tools.pages.public docs/public_names.txt
	$(BIN)/python -m tools.pages.trend docs/recordings.md
	$(BIN)/python -m tools.pages.notebooks examples/*.ipynb

papers: $(VENV)/test.stamp
	$(BIN)/python -m tools.papers docs

# Every picture of docs/ but that of a long run, which `make soak` draws; those of `view` need a browser.
pictures: $(VENV)/test.stamp
	$(BIN)/python -m tools.pages.pictures docs/gallery
	$(BIN)/python -m tools.pages.architecture docs/gallery/architecture.png
	$(BIN)/python -m tools.pages.limbs docs/gallery/limbs.png
	$(BIN)/python -m tools.pages.robots docs/gallery
	$(BIN)/python -m tools.pages.view docs/gallery

# Needs a browser.
animation: $(VENV)/test.stamp
	$(BIN)/python -m tools.pages.view docs/gallery load

# Strict: a warning is an error.
docs: $(VENV)/docs.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# Processes of nodes count too, and what writes programs: none is stored yet. On a full disk the
# figures themselves could not be written.
coverage: $(VENV)/test.stamp $(VENV)/coverage.stamp
	$(BIN)/coverage erase
	rm -rf out/programs
	OMP_NUM_THREADS=1 PKM_TWIN_CACHE=$(CURDIR)/out/programs $(BIN)/coverage run -m pytest -q -p no:xdist -k 'not full_disk' $(CORES:%=test/%) $(ENDLESS:%=--ignore=%)
	$(BIN)/coverage combine --quiet
	$(BIN)/python -m tools.coverage

mutation: $(VENV)/test.stamp
	OMP_NUM_THREADS=1 $(BIN)/python -m tools.mutation

dist: $(VENV)/test.stamp
	$(BIN)/python -m tools.distribution out/dist

sbom: $(VENV)/demo.stamp
	$(BIN)/python -m tools.distribution out/sbom.json

clean:
	rm -rf $(VENV) out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
