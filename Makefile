# `make demo` and `make test` install everything that they need. They require only Python 3.11+ and make.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out/demo
# The simulated car of the sample logs, with the filter noise that belongs to the shipped network.
CAR := saloon
# Number of test processes; the suite is CPU-bound.
JOBS ?= 2
# Keep Python's bytecode; otherwise each process compiles all tests and sources again.
unexport PYTHONDONTWRITEBYTECODE
INSTALL := $(BIN)/python -m pip install --quiet --constraint constraints.txt
# One thread per process: OpenMP threads in parallel test processes compete for the cores and busy-wait.
# Tests run in random order. The first lines of the output show the seed: make test ORDER_SEED=17 repeats an order.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(if $(ORDER_SEED),--randomly-seed=$(ORDER_SEED))

.PHONY: help demo test quick fleet pages mutants mutants-fixed check lint format bench train-default samples conditions peers benchmark-sideslip torture \
  gates gates-quick gates-freeze recalibrate evidence docs paper strangers wheel release lock clean

help:
	@echo "make demo     run the main job on the sample logs and say where the outputs are"
	@echo "make test     run all tests, in random order (ORDER_SEED=17 repeats one)"
	@echo "make quick    run the quick tests, which touch every package: 45 s on two cores once compiled"
	@echo "make fleet    the tests of fleets, which take long, and need pip install '.[ray]' for those on a cluster"
	@echo "make pages    look at the pages in a browser: their tests, and the pictures of docs/report.md anew (needs Chromium)"
	@echo "make mutants  put small faults into the code and see which of them the tests notice (SEED=1 COUNT=30)"
	@echo "make mutants-fixed  faults that the tests are known to notice: all must still be noticed (three minutes)"
	@echo "make check    formatting, lint, types, import contracts, tests"
	@echo "make torture  damaged, hostile and odd input, counted: docs/reliability.md (four hours or less on two cores; resumable)"
	@echo "make strangers  docs/third_party_logs.md: signals recognised in logs with unknown layouts (under two minutes)"
	@echo "make gates    figures of the tool that moved since they were frozen (an hour; make gates-quick: five minutes)"
	@echo "make bench    speed against peers"
	@echo "make recalibrate  regenerate all that is derived: shipped cars and networks, evidence pages (hours; resumable)"
	@echo "make evidence  regenerate the evidence pages alone, with the shipped cars and networks (hours; resumable)"
	@echo "make train-default  simulate, train and tune the model that the package ships (two cores, half an hour or so)"
	@echo "make samples  write sample_logs/ anew with the simulator"
	@echo "make conditions CAR=car NETWORK=folder  docs/conditions.md: every estimator on the condition table"
	@echo "make peers    docs/peers.md: every estimator on the recorded drives in ../shared, and published ones (three minutes)"
	@echo "make benchmark-sideslip FOLDER=logs  the same table of your own logs with ground truth"
	@echo "make docs     the documentation as a site: out/site/index.html (a broken link is an error)"
	@echo "make paper    the paper's experiment: docs/paper.md, its figures and results"
	@echo "make wheel    dist/: the wheel and the source archive of what is committed, looked at"
	@echo "make release  the same, installed into a new environment, where the sample job runs"
	@echo "make lock     constraints.txt: the versions that make, CI and the container install, from pyproject.toml"
	@echo "make clean    remove the virtual environment and everything that was built"

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "pdhef-logtool needs Python 3.11 or newer; name one with: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
	  { rm -rf $(VENV); echo "$(PYTHON) cannot make virtual environments; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }

$(VENV)/installed: $(BIN)/python pyproject.toml constraints.txt
	$(INSTALL) --editable .
	@touch $@

# Dependencies of an extra: dev, docs or release.
$(VENV)/installed-%: $(VENV)/installed
	$(INSTALL) --editable '.[$*]'
	@touch $@

# The versions that CI and the container install; pyproject.toml has the ranges. CUDA packages are excluded: only
# the CUDA build of torch needs them.
lock: $(VENV)/installed-release
	echo '# Written by `make lock` from pyproject.toml: pip install -c constraints.txt' >constraints.new
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --all-extras --no-header --no-annotate pyproject.toml \
	  | grep -vE '^(cuda-|nvidia-|triton=)' >>constraints.new
	mv constraints.new constraints.txt

# It compiles what its runs need, half of all code.
demo: $(VENV)/installed
	$(BIN)/pdhef run sample_logs/dlc.mcap sample_logs/road.mcap -o $(OUT) --car $(CAR) --plan sample_logs/plan.toml
	$(BIN)/pdhef run sample_logs/sweep.mcap -o $(OUT)-low-friction --car $(CAR) --friction 0.3
	@echo
	@echo "Outputs: $(OUT)/ and $(OUT)-low-friction/"
	@echo "  report.html, logs/<log>/report.html   the run and each drive, for a browser"
	@echo "  logs/<log>/annotated.mcap   for Foxglove, PlotJuggler or ros2 bag"
	@echo "  logs/<log>/recording.rrd    open it with: $(BIN)/pdhef view $(OUT)"
	@echo "  logs/<log>/report.json, estimates.parquet; metrics.parquet and run.json for the whole run"

# The key of the cache of compiled code is a digest of the sources. After an edit, this target or the next run compiles.
$(VENV)/compiled: $(VENV)/installed $(wildcard pdhef_logtool/*.py pdhef_logtool/*/*.py pdhef_logtool/*/*/*.py truthsim/*.py)
	$(BIN)/pdhef compile
	@touch $@

test: $(VENV)/installed-dev $(VENV)/compiled
	$(PYTEST) -n $(JOBS) --dist worksteal

quick: $(VENV)/installed-dev $(VENV)/compiled
	$(PYTEST) -n $(JOBS) --dist worksteal -m "not slow"

pages: $(VENV)/installed-dev $(VENV)/compiled
	$(PYTEST) tests/reports tests/results
	OMP_NUM_THREADS=1 $(BIN)/python tests/reports/screenshots.py

# Tests that take too long for `make test` or need extras: Ray, S3.
fleet: $(VENV)/installed-dev $(VENV)/compiled
	PDHEF_FLEET=1 $(PYTEST) -m fleet

# New mutants: each runs the tests of its package until one fails. Many surviving mutants take hours.
SEED ?= 1
COUNT ?= 30
mutants: $(VENV)/installed-dev $(VENV)/compiled
	OMP_NUM_THREADS=1 $(BIN)/python tests/fixed_mutants.py --seed $(SEED) --draw $(COUNT) --jobs $(JOBS)

# Mutants that the tests detect (tests/fixed_mutants.json); each mutant runs only its test.
mutants-fixed: $(VENV)/installed-dev $(VENV)/compiled
	OMP_NUM_THREADS=1 $(BIN)/python tests/fixed_mutants.py --jobs $(JOBS)

lint: $(VENV)/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tests/size_budget.py
	$(BIN)/python tests/language_check.py

format: $(VENV)/installed-dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

check: lint test

bench: $(VENV)/installed-dev $(VENV)/compiled
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.performance

# The figures are in studies/results/gates.csv. ONLY="conditions contract/options" selects gates or rows; TREE selects
# another source tree.
GATES = $(BIN)/python -m studies.gates --jobs $(JOBS) $(if $(ONLY),--only $(ONLY)) $(if $(TREE),--tree $(TREE))
gates: $(VENV)/installed-dev $(VENV)/compiled
	$(GATES)

gates-quick: $(VENV)/installed-dev $(VENV)/compiled
	$(GATES) --quick

# Write the figures of the current commit to the file; resumable.
gates-freeze: $(VENV)/installed-dev $(VENV)/compiled
	$(GATES) --freeze $$(git rev-parse --short=8 HEAD)

# The stages and durations are in studies/recalibrate.toml. Run some: make recalibrate ONLY="fit extract".
recalibrate: $(VENV)/installed-dev $(VENV)/compiled
	$(BIN)/python -m studies.recalibrate $(if $(ONLY),--only $(ONLY))

evidence: $(VENV)/installed-dev $(VENV)/compiled
	$(BIN)/python -m studies.recalibrate --evidence

train-default: $(VENV)/installed-dev $(VENV)/compiled
	$(BIN)/python -m studies.defaults.train_default

# No --quiet: it hides the warnings that cause a failure.
docs: $(VENV)/installed-docs
	$(BIN)/python -m studies.documentation_tables
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build
	@echo "Site: out/site/index.html"

samples: $(VENV)/installed $(VENV)/compiled
	$(BIN)/python -m truthsim.samples sample_logs

# One core: step times are measured in the same run.
paper: $(VENV)/installed-dev $(VENV)/compiled
	OMP_NUM_THREADS=1 $(BIN)/python -m studies.paper

# Every estimator on the condition table, with the car's own network or another.
DRIVES ?= 10
conditions: $(VENV)/installed-dev $(VENV)/compiled
	OMP_NUM_THREADS=1 $(BIN)/python -m studies.conditions --drives $(DRIVES) --jobs $(JOBS) \
	  --car $(CAR) $(if $(NETWORK),--network $(NETWORK))

peers: $(VENV)/installed-dev $(VENV)/compiled
	OMP_NUM_THREADS=1 $(BIN)/python -m studies.peers

# CAR and MAPPING are those of the folder.
benchmark-sideslip: $(VENV)/installed-dev $(VENV)/compiled
	OMP_NUM_THREADS=1 $(BIN)/python -m studies.peers --folder $(FOLDER) \
	  $(if $(filter command line,$(origin CAR)),--car $(CAR)) $(if $(MAPPING),--mapping $(MAPPING))

torture: $(VENV)/installed-dev $(VENV)/compiled
	$(BIN)/python -m studies.torture --jobs $(JOBS)

# Use the layouts of the last build.
strangers: $(VENV)/installed-dev $(VENV)/compiled
	OMP_NUM_THREADS=1 $(BIN)/python -m studies.strangers --held-out

# Build from a clone, so that only committed files are packaged.
wheel: $(VENV)/installed-release
	rm -rf build/clone dist
	git clone --quiet . build/clone
	$(BIN)/python -m build --outdir dist build/clone >build/build.log 2>&1 || { tail -n 20 build/build.log >&2; exit 1; }
	$(BIN)/python tests/release/check_dist.py dist

# Install and run the wheel outside the source tree, with the same steps as in the Dockerfile. The bill of materials
# (CycloneDX) describes that environment.
release: wheel
	rm -rf build/fresh
	$(PYTHON) -m venv build/fresh
	build/fresh/bin/python -m pip install --quiet --constraint constraints.txt dist/*.whl
	cd build/fresh && bin/pdhef --version && bin/pdhef --help >/dev/null && bin/pdhef compile
	cd build/fresh && bin/pdhef run ../../sample_logs/dlc.mcap --car saloon --estimators all --annotate none -o out
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible -o dist/sbom.cdx.json build/fresh/bin/python
	$(BIN)/python tests/release/check_sbom.py dist/sbom.cdx.json

clean:
	rm -rf $(VENV) out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
