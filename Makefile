# Every target sets up what it needs in .venv first; see tools/setup.sh. PYTHON=... chooses the interpreter.
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help demo test lint notebooks bench clean distclean
SHELL := /bin/bash

bin := .venv/bin
# the notebooks run with the kernel of .venv, whatever kernels this user has elsewhere
export JUPYTER_PREFER_ENV_PATH := 1

help:  ## show this list
	@awk -F ':.*##' '/^[a-z]+:.*##/ { printf "make %-10s %s\n", $$1, $$2 }' Makefile

demo: .venv/.ready-demo  ## estimate the states of an FMU plant; results in demo/
	$(bin)/ctmhe demo --out demo

test: .venv/.ready-test  ## run the tests: fast ones, slow ones, notebooks
	tools/test.sh

lint: .venv/.ready-test  ## check style, types, the order of imports, and that notebooks and their .py agree
	tools/lint.sh

notebooks: .venv/.ready-test  ## rewrite notebooks/*.ipynb from their .py and run them, outputs included
	$(bin)/jupytext --quiet --update --to ipynb notebooks/*.py
	$(bin)/python -m pytest --nbmake --overwrite -W default notebooks/*.ipynb

bench: .venv/.ready-test  ## time ctmhe and its peers; rows in results/benchmarks.json
	mkdir -p results
	$(bin)/python -m benchmarks.solvers --json results/benchmarks.json
	$(bin)/python -m benchmarks.profile_update
	$(bin)/python -m benchmarks.stiff
	$(bin)/python -m benchmarks.limits --json results/limits.json
	$(bin)/python -m benchmarks.fmus --json results/fmus.json
	$(bin)/python -m benchmarks.studies --json results/studies.json

clean:  ## remove what tests, linters and the demo leave behind
	rm -rf demo build dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache fmus/_build
	find . -path ./.venv -prune -o -name __pycache__ -type d -exec rm -rf {} +

distclean: clean  ## the same, and .venv
	rm -rf .venv

.venv/.ready-%: pyproject.toml CMakeLists.txt tools/setup.sh
	tools/setup.sh $*
