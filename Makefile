# `make demo` and `make test` create the environment and install first, where that is not done.
#   PYTHON       the interpreter that creates the environment, 3.11 or later
#   TORCH        what pip installs first; a build for another device or version, say TORCH='torch==2.12.0' CONSTRAINTS=
#   CONSTRAINTS  the file of pinned versions; empty: the newest that pyproject.toml admits
PYTHON ?= $(shell for p in python3.11 python3 python3.12 python3.13; do \
	$$p -c 'import sys, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
CONSTRAINTS ?= constraints.txt
TORCH ?= $(shell grep '^torch==' constraints.txt)
VENV ?= .venv
TOOLS ?= $(VENV)-tools

pin := $(if $(CONSTRAINTS),-c $(CONSTRAINTS))
bin := $(VENV)/bin
installed := $(VENV)/.installed

.PHONY: help venv demo docs test test-all test-slow test-gpu lint format types sbom audit clean
.DEFAULT_GOAL := help

help:
	@echo 'make demo      install, then learn laws from bodies and video and close one loop: CPU, minutes'
	@echo 'make test      run the fast tests: minutes on two cores'
	@echo 'make test-all  run every test that needs no GPU'
	@echo 'make docs      build the documentation: docs/_build/html/index.html'
	@echo 'make sbom      list what is installed, with licences: sbom.cdx.json, licences.csv'
	@echo 'make audit     look for known vulnerabilities of the pinned dependencies'
	@echo 'make test-slow, test-gpu, lint, format, types, venv, clean'

venv: $(installed)

# torch comes first: its build decides what the rest may need, and a version that is there is not replaced.
$(VENV)/.torch:
	@test -n '$(PYTHON)' || { echo 'make: no Python >= 3.11 with venv found; set PYTHON' >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(bin)/python -m pip install '$(TORCH)'
	@touch $@

$(installed): $(VENV)/.torch pyproject.toml $(CONSTRAINTS)
	$(bin)/python -m pip install $(pin) -e '.[dev]'
	@touch $@

# Examples are run, warnings are errors, internal links are checked. The site is docs/_build/html/index.html.
docs: export OMP_NUM_THREADS = 1
docs: $(VENV)/.docs
	$(bin)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html

$(VENV)/.docs: $(installed)
	$(bin)/python -m pip install $(pin) -e '.[docs]'
	@touch $@

demo: $(installed)
	$(bin)/neuido demo

# One process a core, one thread a process; the tests of a file share their fixtures, so they stay together.
WORKERS ?= auto
pytest := $(bin)/python -m pytest -n $(WORKERS) --dist loadfile

# Compiled modules are kept, whatever the surroundings say: each worker and each command that a test starts would compile them again.
test test-all test-slow: export OMP_NUM_THREADS = 1
test test-all test-slow: export PYTHONDONTWRITEBYTECODE =
test: $(installed)
	$(pytest) -m 'not slow and not gpu'

test-all: $(installed)
	$(pytest) -m 'not gpu'

test-slow: $(installed)
	$(pytest) -m 'slow and not gpu'

# The rollout's tests with every array on the GPU, then the tests that need one (fused laws, graphs, splatting).
test-gpu: $(installed)
	NEUIDO_TEST_DEVICE=cuda $(bin)/python -m pytest tests/physics/mpm/test_simulator.py tests/physics/mpm/test_conservation.py
	$(bin)/python -m pytest -m gpu

lint: $(installed)
	$(bin)/ruff check .
	$(bin)/ruff format --check .

format: $(installed)
	$(bin)/ruff check --fix .
	$(bin)/ruff format .

types: $(installed)
	$(bin)/pyright

# The tools live in an environment of their own, so that they are not among what they list.
$(TOOLS)/.installed:
	$(PYTHON) -m venv $(TOOLS)
	$(TOOLS)/bin/python -m pip install 'cyclonedx-bom>=7' 'pip-licenses>=5' 'pip-audit>=2.9'
	@touch $@

sbom: $(installed) $(TOOLS)/.installed
	$(TOOLS)/bin/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible -o sbom.cdx.json $(bin)/python
	$(TOOLS)/bin/pip-licenses --python $(bin)/python --format csv --with-urls --output-file licences.csv

audit: $(TOOLS)/.installed
	$(TOOLS)/bin/pip-audit -r constraints.txt --no-deps --disable-pip --progress-spinner off

clean:
	rm -rf $(VENV) $(TOOLS) sbom.cdx.json licences.csv build dist .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -not -path './.git/*' -prune -exec rm -rf {} +
