# The commands of the project: `make help` lists them.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
TOOLS := $(VENV)/.installed-tools
# Compiled on first use: most of what is installed is never imported.
PIP := $(BIN)/python -m pip --quiet install --no-compile

.DEFAULT_GOAL := help
.PHONY: help install demo test lint smoke precision bench bench-full effect-pictures reproduce reproduce-full clean

help: ## list these commands
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(firstword $(MAKEFILE_LIST)) | expand -t 17

install: $(TOOLS) ## make the environment .venv (the others do so when needed)

$(INSTALLED): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "pixcal needs Python 3.11 or newer, $(PYTHON) is not; try: make PYTHON=python3.12" >&2; \
	  exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade 'pip>=25.1'
	$(PIP) --editable .
	@touch $@

$(TOOLS): $(INSTALLED)
	$(PIP) --group dev
	@touch $@

demo: $(INSTALLED) ## calibrate the sample acquisition into demo/
	$(BIN)/pixcal run data_samples/demo --out demo

test: $(TOOLS) ## run the tests
	$(BIN)/pytest

lint: $(TOOLS) ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

smoke: $(INSTALLED) ## run every shell command once on a small simulated acquisition
	PATH="$(abspath $(BIN)):$$PATH" .ci/smoke

precision: $(INSTALLED) ## 12 000 simulated frames against their truth (half a minute, 1 GB of disk)
	$(BIN)/python benchmarks/precision.py

bench: $(INSTALLED) ## speed against a bare scan, and beside other methods (6 minutes, 30 GB of disk)
	$(BIN)/python benchmarks/throughput.py
	$(BIN)/python benchmarks/comparison.py

bench-full: $(INSTALLED) ## the same for 46 Mpix: time and memory (20 minutes, 60 GB of disk)
	$(BIN)/python benchmarks/throughput.py --full

effect-pictures: $(INSTALLED) ## what every effect does to the offsets, for docs/effects (two minutes)
	$(BIN)/python benchmarks/effect_pictures.py

reproduce: $(INSTALLED) ## the paper's figures into docs/reproduction (minutes, 4 GB of disk)
	$(BIN)/python benchmarks/reproduce.py

reproduce-full: $(INSTALLED) ## the same in the paper's own sizes (much longer, 12 GB of disk)
	$(BIN)/python benchmarks/reproduce.py --full

clean: ## remove the environment, the demo and all caches
	rm -rf .venv demo work/reproduction build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find pipeline cli tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
