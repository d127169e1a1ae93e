# Everything a user or a maintainer runs. `make demo` and `make test` need nothing but Python 3.11 and a network of packages.
PYTHON ?= python3
BIN := .venv/bin
DEMO := demo.asset

.PHONY: venv demo test stress fuzz bench schemas docs-check model data clean

venv: .venv/.done

.venv/.done: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt torch==2.13.0
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[test,bench,codecs]"
	touch $@

# One image to a finished asset, in ./demo.asset
demo: venv
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python examples/demo.py

test: venv
	$(BIN)/python -m pytest -m "not slow"

stress: venv
	$(BIN)/python -m pytest -m slow

# Ten minutes of damaged files for every reader; what breaks one stays as a test.
fuzz: venv
	$(BIN)/python -m tests.faults.fuzz 10

bench: venv
	$(BIN)/python benchmarks/pipeline.py

docs-check: venv
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python tests/tools/docs_check.py

# The JSON Schemas from the types that decode the manifests; a test compares.
schemas: venv
	$(BIN)/python -m gdtool.folders.schema schemas

clean:
	rm -rf .venv *.egg-info build *.asset
