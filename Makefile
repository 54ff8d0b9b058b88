# make demo: fine-tune and predict with the device side alone, in a fresh clone.
# make test: everything that has to pass before a change goes in.

DEMO_FRAME ?= calib/demo_object.png
DEMO_SCENE ?= calib/demo_scene.png
DEMO_OUT ?= demo

PYTHON ?= $(shell command -v python3.11 || command -v python3)
PIP := -m pip install --disable-pip-version-check --quiet

# Whatever ends up in the wheel: a change here installs again, nothing else does.
PACKAGED := pyproject.toml README.md $(shell find qsgm calib export -type f -not -name '*.pyc')

TIMES ?= 50

.PHONY: help demo test robustness mutants versions lint format clean
.DEFAULT_GOAL := help

help:  ## show these lines
	@awk -F ':.*## ' '/^[a-z]+:.*## /{printf "make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: .venv/installed  ## fine-tune on one frame in int8, find the object in another
	mkdir -p $(DEMO_OUT)
	.venv/bin/qsgm finetune --int8 -o $(DEMO_OUT)/object $(DEMO_FRAME)
	.venv/bin/qsgm predict --object $(DEMO_OUT)/object -o $(DEMO_OUT)/scene.png $(DEMO_SCENE)
	@echo "pictures: $(DEMO_OUT)/"

test: lint  ## lint, types and tests
	.venv-test/bin/mypy
	.venv-test/bin/python -m pytest --numprocesses auto --dist loadfile

robustness: .venv-test/installed  ## fuzz, kill and starve it for long; counts at the end
	QSGM_ROBUSTNESS=$(TIMES) .venv-test/bin/python -m pytest tests/robustness

mutants: .venv-test/installed  ## do the tests bite? an hour of a core; goes on where it was stopped
	.venv-test/bin/python $(PIP) coverage
	test -f mutants/coverage || .venv-test/bin/python benchmarks/mutants collect
	.venv-test/bin/python benchmarks/mutants run

versions: .venv-test/installed  ## the device side's tests on old and new versions, without torch
	benchmarks/versions.sh

lint: .venv-test/installed  ## check style and formatting
	.venv-test/bin/ruff check .
	.venv-test/bin/ruff format --check .

format: .venv-test/installed  ## mend style and formatting
	.venv-test/bin/ruff check --fix .
	.venv-test/bin/ruff format .

clean:  ## remove environments, caches and the demo's output
	rm -rf .venv .venv-test .mypy_cache .pytest_cache .ruff_cache .hypothesis build dist $(DEMO_OUT)
	find qsgm tests -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/installed: .venv/bin/python $(PACKAGED)
	.venv/bin/python $(PIP) .
	touch $@

.venv-test/bin/python:
	$(PYTHON) -m venv .venv-test

# Editable: only a change of the dependencies installs again.
.venv-test/installed: .venv-test/bin/python pyproject.toml constraints.txt
	.venv-test/bin/python $(PIP) --constraint constraints.txt --editable '.[train,dev]'
	touch $@
