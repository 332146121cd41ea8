# The commands of the project: `make help` lists them.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
TOOLS := $(VENV)/.installed-tools
DOCS := $(VENV)/.installed-docs
# Of the whole blind examination; each is used once (docs/appendix/blind.md).
SEED ?= 2004
# Compiled on first use: most of what is installed is never imported.
QUIETLY := --quiet install --no-compile
# Takes longer than all the rest of an installation: only where nothing else can install.
PIP := $(BIN)/python -m ensurepip >/dev/null && $(BIN)/python -m pip $(QUIETLY)
# uv takes a third of the processor time of pip, which installs what uv cannot.
install = PATH="$$PATH:$(BIN)" uv pip install --quiet --python $(BIN)/python $(1) 2>/dev/null || { $(PIP) $(1); }
# Where it is set, every process would compile all that it imports: seconds each.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help install demo test test-long lint smoke wheel-check docs doc-pages precision bench bench-run bench-full cluster fuzz torture sensors power effect-pictures reproduce reproduce-full blind blind-second blind-full clean

help: ## list these commands
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(firstword $(MAKEFILE_LIST)) | expand -t 17

install: $(TOOLS) ## make the environment .venv (the others do so when needed)

$(INSTALLED): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "pixcal needs Python 3.11 or newer, $(PYTHON) is not; try: make PYTHON=python3.12" >&2; \
	  exit 1; }
	$(PYTHON) -m venv --without-pip $(VENV)
	-@command -v uv >/dev/null || \
	  $(PYTHON) -m pip --python $(BIN)/python $(QUIETLY) uv 2>/dev/null || { $(PIP) uv; }
	@$(call install,pip --editable .)
	@touch $@

$(TOOLS): $(INSTALLED)
	@$(call install,--upgrade 'pip>=25.1')
	@$(call install,--group dev)
	@touch $@

$(DOCS): $(INSTALLED)
	@$(call install,--upgrade 'pip>=25.1')
	@$(call install,--group docs)
	@touch $@

demo: $(INSTALLED) ## calibrate the sample acquisition into demo/
	$(BIN)/pixcal run data_samples/demo --out demo

# Several files at a time: threads of one's linear algebra would only wait for another's.
test test-long: export OPENBLAS_NUM_THREADS = 1

# Three files at a time on two cores: some tests wait for processes of their own.
test: $(TOOLS) ## run the tests
	$(BIN)/pytest -n 3 --dist loadfile -m "not long" --durations=15

test-long: $(TOOLS) ## run the tests that take longest: commands of the pages, faults, whole diagnoses (minutes)
	$(BIN)/pytest -n 2 --dist loadfile -m long --durations=15

lint: $(TOOLS) ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

smoke: $(INSTALLED) ## run every shell command once on a small simulated acquisition
	PATH="$(abspath $(BIN)):$$PATH" .ci/smoke

wheel-check: $(TOOLS) ## build sdist and wheel, install the wheel elsewhere, run the demo there (minutes)
	.ci/wheel-check $(VENV)

docs: $(DOCS) ## build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --site-dir site

doc-pages: $(INSTALLED) ## write again what is generated in docs/: help texts, the picture of the layers
	$(BIN)/python benchmarks/doc_pages.py

precision: $(INSTALLED) ## 12 000 simulated frames against their truth (half a minute, 1 GB of disk)
	$(BIN)/python benchmarks/precision.py

bench: $(INSTALLED) ## speed against a bare scan, and beside other methods (6 minutes, 30 GB of disk)
	$(BIN)/python benchmarks/chain.py
	$(BIN)/python benchmarks/throughput.py
	$(BIN)/python benchmarks/comparison.py

CASES = ordinary:5 lag/traps:6
bench-run: $(INSTALLED) ## time and peak memory of `pixcal run` on two benches that pixcal did not write (4 minutes); CASES=all:7 for all
	$(BIN)/python benchmarks/run_cost.py $(CASES)

bench-full: $(INSTALLED) ## the same for 46 Mpix: time and memory (20 minutes, 60 GB of disk)
	$(BIN)/python benchmarks/throughput.py --full

cluster: $(TOOLS) ## ingest to maps on hosts of a network of which one vanishes (a minute)
	$(BIN)/python benchmarks/cluster.py

fuzz: $(INSTALLED) ## bad input in thousands of cases, for docs/appendix/fuzz.md (under ten minutes on two cores)
	$(BIN)/python benchmarks/fuzz.py --write

torture: $(TOOLS) ## faults of all kinds done on purpose, for docs/appendix/torture.md (12 minutes)
	$(BIN)/python benchmarks/torture.py

sensors: $(INSTALLED) ## all kinds of simulated cameras without fringes, diagnosed, into work/sensors (hours)
	$(BIN)/python benchmarks/sensors.py --draws 2 --seed $(SEED) --out work/sensors

power: $(INSTALLED) ## from which strength on the diagnosis names each effect, and false causes, into work/ (hours)
	$(BIN)/python benchmarks/power.py

errors: $(INSTALLED) ## measured parameters of every effect against the truth, over their errors, into work/ (an hour)
	$(BIN)/python benchmarks/errors.py --draws 40

effect-pictures: $(INSTALLED) ## what every effect does to the offsets, for docs/reference/effects (two minutes)
	$(BIN)/python benchmarks/effect_pictures.py

reproduce: $(INSTALLED) ## the paper's figures into docs/appendix/reproduction (minutes, 4 GB of disk)
	$(BIN)/python benchmarks/reproduce.py

reproduce-full: $(INSTALLED) ## the same in the paper's own sizes (much longer, 12 GB of disk)
	$(BIN)/python benchmarks/reproduce.py --full

blind: $(TOOLS) ## ten small cases whose effects are withheld, diagnosed and scored (minutes)
	[ -e work/blind ] || \
	  $(BIN)/pixcal blind make --cases 10 --seed 1001 --out work/blind --sealed work/blind-truth.json
	$(BIN)/pixcal blind run work/blind
	$(BIN)/pixcal blind score work/blind --sealed work/blind-truth.json

blind-second: $(TOOLS) ## 100 cases of the second bench alone (hours, 7 GB of disk); goes on where it was
	@$(call install,--editable '.[second-bench]')
	[ -e work/blind-second ] || \
	  $(BIN)/pixcal blind make --cases 100 --seed $(SEED) --size standard --bench second \
	  --out work/blind-second --sealed work/blind-second-truth.json
	$(BIN)/pixcal blind run work/blind-second --cluster processes --memory 4GiB
	$(BIN)/pixcal blind score work/blind-second --sealed work/blind-second-truth.json

blind-full: $(TOOLS) ## 200 cases of 128 x 128 pixels (hours, 15 GB of disk); another SEED for another examination
	[ -e work/blind-full ] || \
	  $(BIN)/pixcal blind make --cases 200 --seed $(SEED) --size standard \
	  --out work/blind-full --sealed work/blind-full-truth.json
	$(BIN)/pixcal blind run work/blind-full --cluster processes --memory 4GiB
	$(BIN)/pixcal blind score work/blind-full --sealed work/blind-full-truth.json --oracle 20 \
	  --cluster processes --memory 4GiB

clean: ## remove the environment, the demo and all caches
	rm -rf .venv demo site work/reproduction build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find pipeline cli bench tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
