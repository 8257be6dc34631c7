# Two commands matter: `make demo` and `make test`. Each sets everything up by itself.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

.PHONY: demo test lint bench avatar clean

demo: $(VENV)/.demo            ## serve the default avatar, send it a motion, write a GLB and a contact sheet
	$(BIN)/caphy demo

test: $(VENV)/.dev             ## the whole test suite
	$(BIN)/pytest

lint: $(VENV)/.dev             ## ruff, pyright and the import layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

bench: $(VENV)/.dev            ## latency, HTTP, training and solver figures, as ratios measured in one run
	$(BIN)/python -m benchmarks

MOCAP ?= cmu_mocap
avatar: $(VENV)/.dev           ## train the bundled default avatar again: make avatar MOCAP=folder-of-CMU-clips
	$(BIN)/caphy train caphy/data/garments/tshirt.npz $(MOCAP) -o runs/tshirt
	$(BIN)/caphy train caphy/data/garments/trousers.npz $(MOCAP) -o runs/trousers
	$(BIN)/caphy export runs/tshirt runs/trousers -o caphy/data/avatars/default

$(VENV)/.python:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	touch $@

$(VENV)/.demo: $(VENV)/.python pyproject.toml
	$(BIN)/pip install --quiet --editable '.[render]'
	touch $@

# torch goes first and alone: its exact pin is the CPU build where there is no CUDA.
$(VENV)/.dev: $(VENV)/.python pyproject.toml
	$(BIN)/pip install --quiet torch==2.13.0
	$(BIN)/pip install --quiet --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) build dist demo-out *.egg-info
