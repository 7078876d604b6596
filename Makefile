PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export OMP_NUM_THREADS ?= 1

# The version of a Python that is too old; empty for one that is not.
TOO_OLD = $(shell $(PYTHON) -c 'import sys; v = sys.version_info[:2]; \
	sys.stdout.write("" if v >= (3, 11) else "Python %d.%d" % v)' 2>&1)

.PHONY: leaderboard publish test lint benchmark docs clean

leaderboard: $(VENV)/installed
	@begun=$$(date +%s) && \
	$(BIN)/python scripts/leaderboard.py && \
	played=$$(date +%s) && \
	$(BIN)/pinnobs report runs/leaderboard/rows.jsonl -o runs/leaderboard/site && \
	ended=$$(date +%s) && \
	echo "installation, once: $$(cat $(VENV)/installed) s; leaderboard:" \
		"$$((played - begun)) s; page: $$((ended - played)) s"

publish: $(VENV)/installed
	$(BIN)/python scripts/publish.py

test: $(VENV)/installed-dev
	$(BIN)/pytest -n 2

lint: $(VENV)/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

benchmark: $(VENV)/installed-dev
	$(BIN)/python scripts/benchmark.py

docs: $(VENV)/installed-docs
	$(BIN)/python -m sphinx -W --keep-going -q -j auto docs docs/_build/html
	@echo "open docs/_build/html/index.html"

$(VENV)/bin/python:
	$(if $(TOO_OLD),$(error Python 3.11 or newer is needed; "$(PYTHON)" is $(TOO_OLD): \
		try make PYTHON=python3.12))
	$(PYTHON) -m venv $(VENV)

# The file holds the duration of the installation in s.
$(VENV)/installed: pyproject.toml | $(VENV)/bin/python
	@begun=$$(date +%s) && \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "torch>=2.8,<2.14" && \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[report]" && \
	echo $$(($$(date +%s) - begun)) > $@

$(VENV)/installed-dev: pyproject.toml | $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev]"
	touch $@

$(VENV)/installed-docs: pyproject.toml | $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[docs]"
	touch $@

clean:
	rm -rf $(VENV) build dist docs/_build docs/jupyter_execute docs/reference *.egg-info
