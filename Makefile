# Two commands do all the set-up on a machine with only Python >= 3.10 and make:
#   make demo    run the example session, print where to look
#   make test    format, lint, types, and the quick tests; those in a browser need Chromium (apt-get install chromium)
# make test-full the same with every test: what continuous integration runs; WORKERS=4: as many tests at once
# make venv      only make the environment; make clean: remove what these made
# make wheel     a wheel in dist/, installed with what it needs into an environment of its own outside of the tree, and tried
#                there; PYTHONS="python3.10 python3.13": with each of these
# make docs      the documentation as a site, in site/; make docs-serve: at http://127.0.0.1:8000, anew at every change
# make pages     docs/commands.md, docs/configuration.md and the JSON schema of scene.yaml anew, from the program

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
DEMO := examples/workshop
DEMO_OUT := $(DEMO)/runs

WORKERS ?= 2
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

PYTHONS ?= $(PYTHON)

.PHONY: demo checks test test-full wheel docs docs-serve pages venv clean

demo: $(VENV)/.installed
	$(BIN)/devrf-pipeline run $(DEMO)/scene.yaml --preset tiny

checks: $(VENV)/.installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python

test: checks
	$(PYTEST) -m "not full"

test-full: checks
	$(PYTEST)

wheel: $(VENV)/.python
	rm -rf build dist
	$(BIN)/python -m pip wheel --disable-pip-version-check --quiet --no-deps --wheel-dir dist .
	for python in $(PYTHONS); do .ci/wheel "$$python" dist/*.whl || exit 1; done

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

docs-serve: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve

pages: $(VENV)/.installed
	$(BIN)/typer devrf.pipelines.cli.main utils docs --name devrf-pipeline --output docs/commands.md
	$(BIN)/python docs/site/configuration.py

venv: $(VENV)/.installed

clean:
	rm -rf $(VENV) $(DEMO_OUT) build dist site *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +

$(VENV)/.installed: pyproject.toml setup.py constraints.txt | $(VENV)/.python
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(VENV)/.installed-dev: pyproject.toml setup.py constraints.txt | $(VENV)/.python
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[dev,docs,export,methods,ray,simulate,viewer]'
	touch $(VENV)/.installed $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[docs]'
	touch $@

$(VENV)/.python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	  echo "$(PYTHON) is $$($(PYTHON) --version 2>&1); Python 3.10 or newer is needed: make $(MAKECMDGOALS) PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	touch $@
