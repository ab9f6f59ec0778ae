# Set-up, demo and tests of sagemp; `make` lists the targets. Needs Python 3.11 to 3.13 and make, nothing else.
# PYTHON=... picks the interpreter, VENV=... the environment's folder.

SHELL := /bin/sh
VENV ?= .venv
BIN := $(VENV)/bin
SUPPORTED := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
PYTHON ?= $(shell for p in python3.11 python3 python3.12 python3.13; do \
	if $$p -c '$(SUPPORTED)' >/dev/null 2>&1; then echo $$p; break; fi; done)

# One thread per process: two processes with default threads on two cores run many times slower.
export OMP_NUM_THREADS = 1

.DEFAULT_GOAL := help
.PHONY: help venv demo check test test-fast lint types reproduce-figures safety-table benchmark campaign clean

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1|\2/p' $(MAKEFILE_LIST) | \
		while IFS='|' read -r name text; do printf '  make %-18s %s\n' "$$name" "$$text"; done

venv: $(VENV)/.installed  ## create the environment in .venv from requirements.lock

# The Linux build of torch on the public index needs GPU libraries that the lock leaves out; they are fetched
# only where torch does not start without them.
$(VENV)/.installed: requirements.lock pyproject.toml
	@test -n '$(PYTHON)' || { echo 'no Python 3.11 to 3.13 found; name one with make PYTHON=/path/to/python' >&2; exit 2; }
	@$(PYTHON) -c '$(SUPPORTED)' || { echo '$(PYTHON) is not a Python 3.11 to 3.13' >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements.lock
	@$(BIN)/python -c 'import torch' 2>/dev/null || \
		$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

demo: venv  ## the whole pipeline on the unicycle with reduced data and training: a certificate in minutes
	$(BIN)/sagemp run experiment=unicycle_node effort=demo

check: lint types test  ## all that continuous integration runs

# Tests share out among the cores; each process has one thread.
test: venv  ## run the tests
	$(BIN)/python -m pytest --numprocesses logical --dist worksteal

test-fast: venv  ## the tests of everyday: all but the slow ones
	$(BIN)/python -m pytest --numprocesses logical --dist worksteal -m 'not slow'

lint: venv  ## check style and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: venv  ## check types (pyright's standard mode)
	$(BIN)/basedpyright --pythonpath $(BIN)/python

# An unknown or falsified verdict (exit codes 5 and 10) has a figure too.
reproduce-figures: venv  ## make every artifact and figure at full effort
	@for experiment in $$($(BIN)/python -c 'from sagemp_cli.config.composition import options_of; print(*options_of("experiment"))'); do \
		$(BIN)/sagemp run experiment=$$experiment; code=$$?; \
		case $$code in 0|5|10) ;; *) exit $$code;; esac; \
	done
	$(BIN)/python -m sagemp_cli.report.reproduce

safety-table: venv  ## safety rates of diffusion and flow matching beside the paper's
	@for experiment in planar_diffusion planar_cfm; do \
		$(BIN)/sagemp run --until train-tracker experiment=$$experiment && \
		$(BIN)/sagemp safety-rates experiment=$$experiment || exit $$?; \
	done
	$(BIN)/sagemp safety-rates --table

benchmark: venv  ## run the benchmarks
	$(BIN)/python benchmarks/reachability.py

campaign: venv  ## attack every tube there is with ten million rollouts
	$(BIN)/python benchmarks/campaign.py

clean:  ## remove the environment and caches; artifacts/ stays
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './.git/*' -prune -exec rm -rf {} +
