# `make demo` and `make test` need only Python 3.10 or newer and access to the package index.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test lint docs pages bench samples notebooks dist clean

demo: $(VENV)/.demo  ## replay the sample traces
	$(BIN)/lae-sim replay traces/synthetic-slow.parquet traces/synthetic-fast.parquet

test: $(VENV)/.test  ## run the tests
	$(BIN)/python -m pytest -n auto --dist worksteal

lint: $(VENV)/.dev  ## format, lint, types and the order of imports
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(VENV)/.docs  ## build the site of docs/ in site/; warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

pages: $(VENV)/.test  ## write the outputs that README.md and docs/ show anew
	$(BIN)/python tests/pages.py

bench: $(VENV)/.test  ## measure speed and memory beside their targets; compiled, if numba is there
	$(BIN)/python benchmarks/bench.py

samples: $(VENV)/.demo  ## make the sample traces anew
	$(BIN)/python traces/make_samples.py
	$(BIN)/python traces/make_cases.py

notebooks: $(VENV)/.test  ## run the notebooks, and store them with what they print and draw
	$(BIN)/python tests/stored_notebooks.py

dist: $(VENV)/.dev  ## build wheel and sdist in dist/, and check them as the index would
	rm -rf dist
	$(BIN)/python -m build --outdir dist
	$(BIN)/twine check --strict dist/*

clean:
	rm -rf $(VENV)

$(BIN)/python:
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }  # Debian needs python3-venv

$(VENV)/.demo: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(VENV)/.test $(VENV)/.dev $(VENV)/.docs: $(VENV)/.%: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$*]'
	touch $@
