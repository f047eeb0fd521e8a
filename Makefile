# Two commands do all the set-up on a machine with only Python >= 3.10 and make:
#   make demo    run the example session, print where to look
#   make test    format, lint, types, tests
# make venv      only make the environment; make clean: remove what these made

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
DEMO := examples/waving-sheet
DEMO_OUT := $(DEMO)/runs

.PHONY: demo test venv clean

demo: $(VENV)/.installed
	$(BIN)/devrf-pipeline run $(DEMO)/scene.yaml --preset tiny

test: $(VENV)/.installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/python -m pytest

venv: $(VENV)/.installed

clean:
	rm -rf $(VENV) $(DEMO_OUT) build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +

$(VENV)/.installed: pyproject.toml setup.py constraints.txt | $(VENV)/.python
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[dev,ray,simulate]'
	touch $@

$(VENV)/.python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	  echo "$(PYTHON) is $$($(PYTHON) --version 2>&1); Python 3.10 or newer is needed: make $(MAKECMDGOALS) PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	touch $@
