# Needs Python >= 3.11, make and a package index, nothing else. `make help` lists the targets.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
CHECKED := jaxreg tests $(wildcard *.py) benchmarks research examples
CASES ?= ../shared/cases ../shared/cases_jax
PEERS ?= data/peers
RIENET := $(wildcard $(PEERS)/rie_modelnet.npz)
export JAX_PLATFORMS ?= cpu

.PHONY: help demo test coverage slow lint types wheel docs fuzz cases mutants tables figures baselines clean

help:  ## list the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /\1\t/' | expand -t 12

demo: $(VENV)/.installed  ## train on procedural shapes, evaluate, draw a pair (4 minutes, 2 cores)
	$(BIN)/python train.py configs/synthetic_cpu.toml --workdir runs/demo
	$(BIN)/python evaluate.py configs/synthetic_cpu.toml --checkpoint runs/demo --picture runs/demo/pair.png

test: $(VENV)/.installed-dev  ## run the tests (8 minutes, 2 cores)
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow" --durations=10

coverage: $(VENV)/.installed-dev  ## the same, and which lines they miss (a quarter slower)
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow" --cov --cov-report=term

slow: $(VENV)/.installed-dev  ## run the tests that `make test` leaves out
	$(BIN)/python -m pytest -m slow

lint: $(VENV)/.installed-dev  ## style, and the order of imports between the packages
	$(BIN)/ruff check $(CHECKED)
	$(BIN)/ruff format --check $(CHECKED)
	$(BIN)/lint-imports

types: $(VENV)/.installed-dev  ## what pyright says of the package
	$(BIN)/pyright --pythonpath $(BIN)/python

wheel: $(BIN)/python  ## build the wheel, install it without extras elsewhere, and use it (2 minutes)
	$(BIN)/python tests/wheel.py

fuzz: $(VENV)/.installed-dev  ## 10,000 examples of whatever may be given to register()
	$(BIN)/python -m pytest -n 2 tests/scans/test_fuzz.py --hypothesis-profile=fuzz

cases: $(VENV)/.installed-dev  ## run the case scripts in the folders $(CASES), where there are any
	@$(BIN)/python tests/cases.py $(CASES)

mutants: $(VENV)/.installed-dev  ## break each kernel on purpose: the tests must notice
	$(BIN)/python tests/mutants.py

baselines: $(VENV)/.installed-baselines  ## install Open3D, small_gicp and KISS-Matcher for the classical rows

tables: $(VENV)/.installed-baselines  ## the paper's tables: all pairs, then all its methods (40 minutes)
	$(BIN)/python -m benchmarks.paper.tables --jobs 2 $(RIENET:%=--rienet %)
	$(BIN)/python -m benchmarks.paper.peers $(and $(RIENET),--folder $(PEERS))

figures: $(VENV)/.installed  ## the pictures of the documentation
	$(BIN)/python -m benchmarks.figures

docs: $(VENV)/.installed-docs  ## build the site (open site/index.html); a broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:  ## remove the environment, caches and runs
	rm -rf $(VENV) runs build dist site .pytest_cache .ruff_cache .hypothesis .import_linter_cache .coverage*
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "jaxreg needs Python >= 3.11, and $(PYTHON) is older: make PYTHON=/path/to/python ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable ".[train,view]"
	@touch $@

$(VENV)/.installed-dev: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-baselines: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable ".[train,view,baselines]"
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable ".[docs]"
	@touch $@ $(VENV)/.installed
