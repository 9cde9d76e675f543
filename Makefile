# All commands for users and CI, from a fresh checkout: `make help`.
SHELL := bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CORES ?= 2
CONFIG ?= demo
COMMA := ,
PART = $(if $(METHODS),--methods $(METHODS)) $(if $(DATASETS),--datasets $(DATASETS)) $(if $(TESTS),--tests $(TESTS))
# Tests that are quick enough where kernels run as plain Python.
INTERPRETED := $(patsubst %,tests/unit/test_%.py,without_compiler io plot result problem pose sample) \
  $(patsubst %,tests/properties/test_%.py,line line_assignment assignment sorting)
PYTEST := $(BIN)/python -m pytest -n $(CORES) --dist loadscope --no-loadscope-reorder
# Every stage and many tests start a process: without stored bytecode each would compile all packages again.
export PYTHONDONTWRITEBYTECODE :=
SYSTEM_PACKAGES := libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6
BROWSER_PACKAGES := chromium chromium-driver

.DEFAULT_GOAL := help

## demo: set up, run a small benchmark on synthetic shapes and print the path of the report
.PHONY: demo
demo: setup
	@$(MAKE) --no-print-directory run CONFIG=demo

## test: set up, then check style and types, run all tests and list the 20 slowest
.PHONY: test
test: dev browser
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@# mypy runs next to the tests; both must pass
	@$(BIN)/mypy & types=$$!; $(PYTEST) --durations=20; tests=$$?; \
	wait $$types || { echo "mypy found errors: see above"; exit 1; }; exit $$tests

## coverage: measure line coverage of the library, with kernels as plain Python; pages in results/coverage
.PHONY: coverage
coverage: dev
	@NUMBA_DISABLE_JIT=1 EXAMPLES=10 $(PYTEST) -q --timeout=1800 $(INTERPRETED) --cov=dcreg \
	  --cov-report=term --cov-report=html:results/coverage

## run: run the experiment CONFIG=demo|real2d|paper3d-quick|…; METHODS=a,b DATASETS=… TESTS=… select a part; BESIDE=1: on archived instances
.PHONY: run
run: setup
	@$(BIN)/python -m workflows run $(CONFIG) --cores $(CORES) $(PART) $(BESIDE:%=--beside)

## paper-2d: run the paper's 2D tests (POINTS=40: 40 points per shape; QUICK=1, also for the next five targets: at most 15 minutes each)
## paper-2d-cr: run the tests of the public point sets of Chui and Rangarajan
## paper-2d-images: run the test on photographs, with edges and with manually marked points
## paper-3d: run the paper's 3D tests (POINTS=40: 40 points per shape)
## sensitivity: run methods with wrong n_inliers and wrong noise bounds
## threedmatch: run the official 3DMatch and 3DLoMatch lists; write recalls and a figure (NORMALS=oriented: better features)
EXPERIMENT = $(subst -,_,$(subst paper-,paper,$@))$(if $(NORMALS),_$(NORMALS))$(if $(POINTS),-$(POINTS))$(if $(QUICK),-quick)
.PHONY: paper-2d paper-2d-cr paper-2d-images paper-3d sensitivity threedmatch
paper-2d paper-2d-cr paper-2d-images paper-3d sensitivity threedmatch: setup
	@$(BIN)/python -m workflows run $(EXPERIMENT) --cores $(CORES) $(PART) $(BESIDE:%=--beside)
	@$(if $(filter threedmatch,$@),$(BIN)/python -m reports threedmatch $(EXPERIMENT) $(PART))

## claims: check the claims of the paper against all available results; print the path of the page
.PHONY: claims
claims: setup
	@$(BIN)/python -m reports claims

## paper-figures: draw every figure of the paper from the available results, for print and as a page
.PHONY: paper-figures
paper-figures: setup
	@$(BIN)/python -m reports figures

## findings: run the experiment behind docs/findings.md, archive all results and write the page (TRIALS=0,1: a part)
.PHONY: findings
findings: setup
	@$(BIN)/python -m workflows run findings --cores $(CORES) $(if $(TRIALS),--trials $(TRIALS))
	@$(BIN)/python -m reports archive
	@$(BIN)/python -m reports findings

## evidence: spend HOURS=2 on the runs that decide claims soonest; the same command continues (EXPERIMENTS=paper2d-40,paper3d-40)
.PHONY: evidence
evidence: $(if $(strip $(PART)),no-part) setup
	@$(BIN)/python -m reports evidence --cores $(CORES) $(if $(HOURS),--hours $(HOURS)) $(if $(EXPERIMENTS),--experiments $(EXPERIMENTS))

.PHONY: no-part
no-part:
	@echo "make evidence chooses methods, datasets and tests itself; choose EXPERIMENTS instead" >&2; exit 2

## archive: write all results to reports/archive/VERSION (default: the version of dcreg; REPLACE=1: even if fewer runs)
.PHONY: archive
archive: setup
	@$(BIN)/python -m reports archive $(if $(VERSION),--version $(VERSION)) $(if $(REPLACE),--replace)

## snakemake-report: write Snakemake's own report on the finished experiment CONFIG=…: jobs, times, results
.PHONY: snakemake-report
snakemake-report: setup
	@$(BIN)/python -m workflows snakemake-report $(CONFIG)

## publish: write all results, configs and the code of your methods to results/published/VERSION.zip; print the command that shows them
.PHONY: publish
publish: setup
	@$(BIN)/python -m reports archive --publish --version $(or $(VERSION),mine)

## report: build all pages from an archive without a run, ARCHIVE=version|folder|zip file|address (SHA256=… of a zip file)
.PHONY: report
report: setup
	@test -n '$(ARCHIVE)' || { echo "the archive is missing: make report ARCHIVE=0.2.0 (or a folder, a zip file, an address)" >&2; exit 2; }
	@$(BIN)/python -m reports archived '$(ARCHIVE)' $(if $(SHA256),--sha256 $(SHA256))

## replay: repeat a stored run, RUN=run_id, and compare the results (RESULTS=folder of the stored run; BOXES=1: draw its boxes)
.PHONY: replay
replay: setup
	@test -n "$(RUN)" || { echo "the run is missing: make replay RUN=run_id (column run_id of tables/runs.csv)" >&2; exit 2; }
	@$(BIN)/python -m $(if $(BOXES),reports boxes,workflows replay) $(RUN) $(if $(RESULTS),--results '$(RESULTS)')

## plan: print the runs of CONFIG=… and their estimated time without running them
.PHONY: plan
plan: setup
	@$(BIN)/python -m workflows run $(CONFIG) --cores $(CORES) $(PART) --dry-run

## baselines: list all methods with availability, version, capabilities and citation
.PHONY: baselines
baselines: setup
	@$(BIN)/python -m workflows baselines

## new-baseline: create a method from the template, NAME=name (IN=folder: in another folder than baselines)
.PHONY: new-baseline
new-baseline: setup
	@test -n "$(NAME)" || { echo "the name is missing: make new-baseline NAME=my_method" >&2; exit 2; }
	@$(BIN)/python -m workflows new-baseline $(NAME) $(if $(IN),--in $(IN))

## check: check methods against the contract, METHOD=name, folder or package
.PHONY: check
check: setup
	@$(BIN)/python -m baselines.check $(METHOD)

## bench: compare the solver with its performance targets, tables in results/bench (QUICK=1: a few seconds)
.PHONY: bench
bench: dev
	@mkdir -p results/bench
	@$(BIN)/python -m pytest tests/bench/bench_solves.py -n 0 -q --timeout=0 --benchmark-columns=min \
	  --benchmark-json=results/bench/raw.json $(if $(QUICK),--quick) $(if $(CASES),-k "$(CASES)")
	@$(BIN)/python -m tests.bench.tables results/bench/raw.json results/bench

## modes: measure the success rate and time of each 3D mode, tables in results/modes (ARGS="--points 300 --limit 5")
.PHONY: modes
modes: setup
	@$(BIN)/python -m workflows.studies.modes results/modes $(ARGS)

## walk: run dcreg with default options on real clouds of many sizes, table in results/walk (ARGS="--size 300")
.PHONY: walk
walk: setup
	@$(BIN)/python -m workflows.studies.walk results/walk $(ARGS)

## first-call: compare the CPU time of the first call in a process with that of an older checkout, OLD=folder
.PHONY: first-call
first-call: dev
	@$(BIN)/python -m tests.bench.first_call $(OLD)

## profile: measure the share of CPU time of each part of the solver
.PHONY: profile
profile: dev
	@$(BIN)/python -m tests.bench.profiling

## bounds: compare the bounds of all methods on the same boxes; print the path of the page
.PHONY: bounds
bounds: setup
	@$(BIN)/python -m workflows.studies.bounds results/bounds
	@$(BIN)/python -m reports bounds results/bounds

## faults: disturb experiments of 500 runs by thirteen kinds of faults; count lost and repeated runs (RUNS=48)
.PHONY: faults
faults: setup
	@$(BIN)/python -m workflows.studies.faults results/faults --runs $(or $(RUNS),500)

## merge: join results or archives of several machines, FROM="A B" OUT=folder (MIXED=1: of different machines)
.PHONY: merge
merge: setup
	@test -n '$(FROM)' && test -n '$(OUT)' || { echo 'sources or folder are missing: make merge FROM="A B" OUT=both/results' >&2; exit 2; }
	@$(BIN)/python -m workflows merge $(FROM) $(if $(MIXED),--mixed-machines) --out '$(OUT)'

## million: make all tables of a million synthetic runs, time and memory in results/million (REPORT=1: the page too)
.PHONY: million
million: setup
	@$(BIN)/python -m workflows.studies.million results/million $(if $(REPORT),--report)

## test-slurm: kill the only node of a Slurm cluster in the middle of an experiment and compare with a local run (root; installs Slurm)
.PHONY: test-slurm
test-slurm: dev
	@$(BIN)/python -m tests.slurm

## golden: compare the TEASER port and mode full with recorded results of official TEASER++ and Go-ICP
.PHONY: golden
golden: setup
	@$(BIN)/python -m workflows.studies.golden

## fuzz: solve COUNT small random problems and count wrong certificates (expected: 0)
.PHONY: fuzz
fuzz: dev
	@$(BIN)/python -m tests.fuzz --count $(or $(COUNT),10000)

## questions: ask each question about COUNT small problems and count wrong answers (expected: 0)
.PHONY: questions
questions: dev
	@$(BIN)/python -m tests.questions --count $(or $(COUNT),1000)

## exact: check COUNT certificates of small 2D problems in integers, count those not proven or wrong (expected: 0)
.PHONY: exact
exact: dev
	@$(BIN)/python -m tests.exact --count $(or $(COUNT),1000)

## refute: ask whether 3DMatch fragments can match, 40 of different scenes and 1,000 with a known pose (ARGS="--limit 1")
.PHONY: refute
refute: setup
	@$(BIN)/python -m workflows.studies.refute results/refute --planted 1000 $(ARGS)

## bad-input: try every kind of bad input and count tracebacks, hangs and unclear messages (expected: 0)
.PHONY: bad-input
bad-input: dev
	@$(BIN)/python -m tests.bad_input

## record: run the experiment regression and record it in reports/history/VERSION (FROM="demo results/x": record existing results)
.PHONY: record
record: setup
	@$(if $(FROM),,$(BIN)/python -m workflows run regression --cores $(CORES) --fresh --no-report)
	@$(BIN)/python -m workflows record $(or $(FROM),regression) $(if $(VERSION),--version $(VERSION))
	@$(BIN)/python -m reports history

## compare: compare recorded versions or results, BASE=… HEAD=… (TIMES=table of timings; JSON=file, TEXT=file: write verdicts; EXACT=1: run by run)
.PHONY: compare
compare: setup
	@$(BIN)/python -m workflows compare "$(BASE)" "$(HEAD)" $(if $(EXACT),--exact) $(if $(TIMES),--times $(TIMES)) \
	  $(if $(JSON),--json $(JSON)) $(if $(TEXT),--text $(TEXT))

## timings: compare CPU time and work with an older checkout, solve by solve, OLD=folder; table in results/timings
.PHONY: timings
timings: dev
	@$(BIN)/python -m tests.bench.interleaved $(OLD) results/timings/times.csv

## history: draw all recorded versions; print the path of the page
.PHONY: history
history: setup
	@$(BIN)/python -m reports history

## library: run the method SOLVER=name on the problem library and print its table (LIMIT=10 seconds; PROBLEMS="tiny fish")
.PHONY: library
library: setup
	@$(BIN)/python -m workflows.library run $(or $(SOLVER),dcreg) $(PROBLEMS) $(if $(LIMIT),--limit $(LIMIT))

## library-check: check all poses of the library by two evaluators, and a sample of its proofs (ALL=1: every proof; proofs too large to store are recomputed)
.PHONY: library-check
library-check: setup
	@$(BIN)/python -m data.library check $(if $(ALL),--all)
	@$(if $(ALL),$(BIN)/python -m workflows.library reprove)

## library-page: build the page of the library in results/library/page
.PHONY: library-page
library-page: setup
	@$(BIN)/python -m reports library

## lock: update the hashes in the lock files; versions stay (needs a network)
.PHONY: lock
lock: $(VENV)-tools/.installed
	@workflows/lock.sh $(VENV)-tools/bin/uv

## audit: look for known vulnerabilities of the locked packages (needs a network)
.PHONY: audit
audit: $(VENV)-tools/.installed
	@workflows/audit.sh $(VENV)-tools/bin/pip-audit

## licences: list the licence of every locked package, and flag copyleft or unknown ones; table in results/licences.csv
.PHONY: licences
licences: dev
	@$(BIN)/python -m workflows.licences results/licences.csv

## lint: format the code, then check style and types
.PHONY: lint
lint: dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	$(BIN)/mypy

## docs: build the manual in results/docs; broken links are errors
.PHONY: docs
docs: dev
	@$(BIN)/python -m sphinx -q -W -b html docs results/docs
	@echo "results/docs/index.html"

## wheel: build the wheel of the library in results/dist; the same commit gives the same bytes
.PHONY: wheel
wheel: setup
	@rm -rf build  # setuptools would also pack what an earlier build left there
	@$(BIN)/python -m pip wheel --quiet --no-deps \
	  --disable-pip-version-check --no-build-isolation --wheel-dir results/dist .
	@sha256sum results/dist/dcreg-*.whl

## lowest: run the library's tests with the oldest packages that pyproject.toml allows (PYTHON=python3.13)
## newest: run the library's tests with the newest packages that pyproject.toml allows (PYTHON=python3.13)
.PHONY: lowest newest
lowest newest:
	@workflows/library_versions.sh $(PYTHON) $@

## setup: create the virtual environment with the locked packages (done by every target that needs it)
.PHONY: setup
setup: $(VENV)/.installed

$(VENV)/.installed: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "Python 3.11 or newer is needed; this is $$($(PYTHON) --version). Set PYTHON=…"; exit 1; }
	@workflows/setup.sh $(VENV) $(PYTHON) $(SYSTEM_PACKAGES)
	@touch $@

## dev: install the tools for tests, style and manual, which `make demo` does not need (done by every target that needs them)
.PHONY: dev
dev: setup $(VENV)/.dev

$(VENV)/.dev: requirements-dev.lock requirements-cluster.lock $(VENV)/.installed
	@echo "Installing the tools for tests, style and manual …"
	@workflows/install.sh $(VENV) \
	  --require-hashes --requirement requirements-dev.lock --requirement requirements-cluster.lock
	@touch $@

# `make lock` and `make audit` have an environment of their own.
$(VENV)-tools/.installed: requirements-tools.lock
	@$(PYTHON) -m venv $(VENV)-tools
	@workflows/install.sh $(VENV)-tools --require-hashes --requirement requirements-tools.lock \
	  || { echo "These tools could not be installed; they need a network."; exit 1; }
	@touch $@

# Only the tests of the report need a browser; without one they are skipped.
.PHONY: browser
browser:
	@command -v chromium >/dev/null || \
	  workflows/system_packages.sh "the browser tests (skipped without it)" $(BROWSER_PACKAGES)

## clean: remove results, caches and the environment, but keep fetched data in resources/
.PHONY: clean
clean:
	rm -rf $(VENV) .venv-lowest .venv-newest $(VENV)-tools results .snakemake .coverage* .pytest_cache .mypy_cache .ruff_cache .hypothesis build *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

## help: print this list
.PHONY: help
help:
	@grep -hE '^## ' $(MAKEFILE_LIST) | sed -E 's/^## ([a-z0-9-]+): (.*)/  make \1\t\2/' | expand -t 22
