# `make demo` runs the main job on a fresh machine, `make test` what every change must pass, `make validate` what needs
# statistics or recordings rendered at full size. Each sets up .venv itself, with what it needs and no more.
PYTHON ?= python3
BIN := .venv/bin
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export OMP_WAIT_POLICY := passive
# What is compiled is kept: hundreds of processes read the same modules.
unexport PYTHONDONTWRITEBYTECODE
# Processes that check types side by side, where mypy knows how to.
export MYPY_NUM_WORKERS := auto

.PHONY: demo test kernels validate lint types platforms win32 darwin docs gallery docs-pictures sample-images benchmark dic-challenge wheel clean

demo: .venv/installed
	$(BIN)/shakercal run sample_images/demo -o demo-results --force

# One process per core, each with one thread; an idle process takes tests over from one that has many left.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal

test: .venv/dev
	$(MAKE) -j 2 -O lint types kernels
	$(PYTEST) -m "not slow"

# Compiled once before all processes of the tests would compile them at the same time.
kernels: .venv/dev
	$(BIN)/shakercal run sample_images/demo -o build/demo --force -q

validate: .venv/dev
	$(PYTEST) -m slow

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev
	$(BIN)/mypy

# The packages for the other systems, whose branches no check on this one sees. Arrays may be anything there, which
# takes a sixth of the time: what numpy's types tell is told by `types`, and is the same on all systems.
platforms: win32 darwin

win32 darwin: .venv/dev
	MYPYPATH=.ci/stubs $(BIN)/mypy --platform $@ --cache-dir .mypy_cache/$@ --no-warn-return-any --no-warn-unused-ignores \
		shakercal photogram shaker fusion

# Pages as a site that opens without a network; every warning is an error.
docs: .venv/docs
	$(BIN)/sphinx-build -q -W --keep-going -E -b html docs build/docs
	@echo build/docs/index.html

# Pages of all presets for the site, with thumbnails in docs/images/gallery and the pictures of the README: some minutes.
gallery: .venv/dev
	$(BIN)/python docs/gallery.py

.venv/docs: .venv/installed
	$(BIN)/python -m pip install --quiet --editable ".[docs]"
	touch $@

# Every picture of the docs, in a browser where they show pages; the published set-up is rendered, which takes minutes.
# Those of the DIC Challenge are of `dic-challenge`.
docs-pictures: .venv/dev
	$(BIN)/python docs/drawings
	$(BIN)/python docs/pictures.py
	$(BIN)/python benchmarks/published.py --docs docs

sample-images: .venv/installed
	$(BIN)/shakercal simulate sample_images/demo --preset demo --seed 1 --force

# The published set-up; times of commands, of subsets beside other programs, of a GPU (without one what it would have to
# do), of pages and the viewer, which go into the pages of the docs.
benchmark: .venv/dev build/peers/installed
	$(BIN)/python benchmarks/nitsche2018.py
	$(BIN)/python benchmarks/commands.py --docs docs
	$(BIN)/python benchmarks/growth.py --docs docs
	$(BIN)/python benchmarks/tracking.py --docs docs --peer-python build/peers/bin/python
	$(BIN)/python benchmarks/gpu.py --docs docs
	$(BIN)/python benchmarks/pages.py --docs docs
	$(BIN)/python benchmarks/view.py --docs docs

# The images of the DIC Challenge by all programs, with its tables and figures: about an hour of one core.
dic-challenge: .venv/dev build/peers/installed
	$(BIN)/python benchmarks/dic_challenge.py --package build/peers/lib/python3*/site-packages/pyvale \
		--peer-python build/peers/bin/python --docs docs

# Programs that track the same pictures, each with what it needs.
build/peers/installed: .venv/made
	$(PYTHON) -m venv build/peers
	PIP_CONSTRAINT= build/peers/bin/python -m pip install --quiet pyvale pyidi al-dic
	touch $@

wheel: .venv/dev
	$(BIN)/python -m build

.venv/made:
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "shakercal needs Python 3.11 or newer")'
	$(PYTHON) -m venv .venv
	touch $@

.venv/installed: .venv/made pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

.venv/dev: .venv/made pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	touch .venv/installed $@

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache demo-results
