# make demo   install the base into .venv and run the demonstration (no setting, no model file needed)
# make serve  serve the map of the demonstration at http://127.0.0.1:8765 (made first where it is not there)
# make test   install everything, MySQL and MariaDB included, then lint, types and all tests
# make test-long   as make test, for the tests that it leaves out: they take minutes each
# make test-train   train a small detector on rendered rooms from random weights; 8 minutes on 2 cores
# make lint   ruff and mypy            make lock    write requirements/constraints.txt anew
# make bench  all benchmarks, on RECORDINGS="..." or a rendered room
# make web    build the page of the service from web/ into semdb/service/page (needs node)
# make wheel  dist/*.whl               make clean   remove what make made
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
LOCK := requirements/constraints.txt
# three processes for two cores, as many tests wait for servers; each process starts servers of its own
PYTEST_ARGS ?= --numprocesses 3 --dist worksteal
# byte code is kept: without it each of the tests' many processes would compile semdb anew
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo serve test test-long test-train unit lint services lock bench web wheel clean

help:
	@sed -n 's/^# \(make \)/\1/p' Makefile

# An environment that exists is kept; stamps say what was installed into it from which lock.
$(BIN)/python:
	@scripts/make-venv.sh $(VENV)

$(VENV)/.stamp-base: pyproject.toml $(LOCK) | $(BIN)/python
	@echo "installing semdb and what it needs into $(VENV)"
	@$(PIP) install --constraint $(LOCK) --editable .
	@touch $@

$(VENV)/.stamp-dev: pyproject.toml $(LOCK) | $(BIN)/python
	@echo "installing semdb with the torch (several GB), worker, serve and development extras into $(VENV)"
	@$(PIP) install --constraint $(LOCK) --editable '.[torch,worker,serve,client,dev]'
	@touch $(VENV)/.stamp-base $(VENV)/.stamp-serve $@

demo: $(VENV)/.stamp-base
	@scripts/demo.sh $(BIN)/semdb

$(VENV)/.stamp-serve: pyproject.toml $(LOCK) | $(BIN)/python
	@echo "installing semdb and the serve extra into $(VENV)"
	@$(PIP) install --constraint $(LOCK) --editable '.[serve]'
	@touch $(VENV)/.stamp-base $@

demo-output/semdb.sqlite3: | $(VENV)/.stamp-base
	@scripts/demo.sh $(BIN)/semdb

serve: $(VENV)/.stamp-serve | demo-output/semdb.sqlite3
	@SEMDB_DATABASE_URL=sqlite:///demo-output/semdb.sqlite3 $(BIN)/semdb serve

services:
	@scripts/install-services.sh

test: $(VENV)/.stamp-dev services lint
	@if command -v npm >/dev/null && ! $(MAKE) --silent web/node_modules/.stamp; then \
	  echo "npm ci failed in web/: what needs it is skipped, or fails where SEMDB_TEST_REQUIRE_NODE is set" >&2; fi
	$(BIN)/python -m pytest $(PYTEST_ARGS)

test-long: $(VENV)/.stamp-dev services
	$(BIN)/python -m pytest -m long --timeout 3600 $(PYTEST_ARGS)

test-train: $(VENV)/.stamp-dev
	$(BIN)/python -m pytest tests/acceptance/train_detector.py --timeout 3600 -s

unit: $(VENV)/.stamp-dev
	$(BIN)/python -m pytest tests/unit $(PYTEST_ARGS)

lint: $(VENV)/.stamp-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

lock:
	@scripts/lock.sh $(LOCK)

# recordings that the benchmarks run on; a rendered room where none is named
RECORDINGS ?= bench-output/room

bench-output/room: | $(VENV)/.stamp-dev
	$(BIN)/semdb synth $@

bench: $(VENV)/.stamp-dev $(RECORDINGS)
	@for file in $$(grep -l '^if __name__' bench/*.py bench/*/__main__.py); do \
	  name=$${file#bench/}; name=$${name%/__main__.py}; name=$${name%.py}; mkdir -p bench-output; \
	  echo "== bench.$$name"; $(BIN)/python -m "bench.$$name" $(RECORDINGS) --json "bench-output/$$name.json"; \
	done

web/node_modules/.stamp: web/package-lock.json
	@npm --prefix web ci --no-audit --no-fund --loglevel=error
	@touch $@

web: web/node_modules/.stamp
	@npm --prefix web run --silent check
	@npm --prefix web run --silent build

wheel: $(VENV)/.stamp-dev
	$(BIN)/python -m build --wheel --no-isolation --outdir dist .

clean:
	rm -rf $(VENV) build dist *.egg-info demo-output bench-output .pytest_cache .mypy_cache .ruff_cache .hypothesis
