# Two commands: `make course` opens the course, `make test` runs every check.
# Each makes .venv once and reuses it.  Settings: PYTHON=python3.12  PORT=8889  PIP_FLAGS="..."

PYTHON ?= python3
PORT ?= 8888
PIP_FLAGS ?=
JOBS ?= 2
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
INSTALL := $(PIP) install --quiet $(PIP_FLAGS) --constraint constraints.txt

# One thread a process: the checks run $(JOBS) processes side by side.
export OMP_NUM_THREADS ?= 1

.PHONY: help course test lint types unit notebooks bench claims site browser chromium clean

help:
	@echo "make course   install what the course needs and open it in JupyterLab"
	@echo "make test     install what the checks need and run all of them"
	@echo "make lint     formatting, lint, types, stripped notebooks"
	@echo "make bench    speed, as ratios measured in one run"
	@echo "make claims   write site/claims.md from the shipped results"
	@echo "make site     build the static site in build/site, offline"
	@echo "make browser  every lesson in JupyterLab, and the built site, in a browser"
	@echo "make clean    remove .venv, caches and build products"

course: $(VENV)/.course-installed
	@JUPYTER_CONFIG_PATH="$(CURDIR)/assets/jupyter" $(BIN)/python -m jupyterlab --port $(PORT)

test: lint types unit notebooks
	@echo "All checks passed."

lint: $(VENV)/.dev-installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/nbstripout --verify --keep-id $(wildcard notebooks/*.ipynb)

types: $(VENV)/.dev-installed
	$(BIN)/mypy

unit: $(VENV)/.dev-installed chromium
	CMC_REQUIRE_BROWSER=1 $(BIN)/python -m pytest -n $(JOBS)

notebooks: $(VENV)/.dev-installed
	CMC_FAST=1 $(BIN)/python -m pytest --nbmake -n $(JOBS) --durations=0 notebooks/

browser: site chromium
	CMC_REQUIRE_BROWSER=1 CMC_SITE="$(CURDIR)/build/site" $(BIN)/python -m pytest tests/test_browser_*.py

chromium: $(VENV)/.dev-installed
	@$(BIN)/python tests/find_browser.py --install

claims: $(VENV)/.dev-installed
	$(BIN)/python site/claims.py

site: $(VENV)/.dev-installed
	$(BIN)/python site/build.py --jobs $(JOBS)

bench: $(VENV)/.dev-installed
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# pip comes as the venv ships it; a half-made venv is thrown away so that the next try starts clean.
$(VENV)/.made:
	@command -v $(PYTHON) >/dev/null 2>&1 || { echo "No $(PYTHON) on the PATH: install Python 3.11 or newer, or run make PYTHON=/path/to/python"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "$(PYTHON) is $$($(PYTHON) -V 2>&1); the course needs Python 3.11 or newer: run make PYTHON=/path/to/newer/python"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { echo "$(PYTHON) lacks the venv module: install it (on Debian and Ubuntu: apt install python3-venv), then run make again"; exit 1; }
	@rm -rf $(VENV)
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo "Could not make $(VENV) with $(PYTHON)"; exit 1; }
	@touch $@

$(VENV)/.course-installed: $(VENV)/.made pyproject.toml constraints.txt
	@echo "Installing the course into $(VENV) (a few minutes the first time) ..."
	@$(INSTALL) --editable . || { echo "The installation failed; environment.md has a troubleshooting section."; exit 1; }
	@touch $@

$(VENV)/.dev-installed: $(VENV)/.made pyproject.toml constraints.txt
	@echo "Installing the course and its checks into $(VENV) (a few minutes the first time) ..."
	@$(INSTALL) --editable ".[dev]" || { echo "The installation failed; environment.md has a troubleshooting section."; exit 1; }
	@touch $@ $(VENV)/.course-installed
