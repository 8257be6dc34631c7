# Two commands matter: `make demo` and `make test`. Each sets everything up by itself.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

.PHONY: demo test lint viewer node-packages bench challenge bench-diagnosis monocular bench-monocular avatar clean

demo: $(VENV)/.demo            ## serve the default avatar, send it a motion, write a GLB and a contact sheet
	$(BIN)/caphy demo

test: $(VENV)/.dev $(VENV)/.node  ## the whole test suite; the viewer's tests need chromium and node (.ci/run installs them)
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist loadfile   # small matrices: two threads take twice as long as one

lint: $(VENV)/.dev             ## ruff, pyright and the import layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

bench: $(VENV)/.dev            ## latency, HTTP, training and solver figures, as ratios measured in one run
	$(BIN)/python -m benchmarks

viewer: $(VENV)/.node          ## build the page's static files from service/viewer/src again
	node service/viewer/build.mjs $(VENV)/node

node-packages: $(VENV)/.node   ## esbuild and three.js for the page, the Khronos validator for the tests

SEED ?= 1
challenge: $(VENV)/.dev        ## make data with a hidden effect, diagnose them, open the sealed answer
	$(BIN)/caphy challenge new --seed $(SEED) -o challenge-out
	$(BIN)/caphy diagnose challenge-out/model.json challenge-out/train_*.npz --base challenge-out/base_*.npz \
		--held-out challenge-out/held_out_*.npz -o challenge-out/diagnosis
	$(BIN)/caphy challenge reveal challenge-out

bench-diagnosis: $(VENV)/.dev  ## does the diagnosis name what was hidden? hours; resumes
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.diagnosis bench-diagnosis.jsonl

monocular: $(VENV)/.monocular  ## the environment of the monocular client: $(VENV)/monocular/bin/python -m service.clients.monocular

bench-monocular: $(VENV)/.dev $(VENV)/.monocular  ## films with known truth through the monocular client; 20 minutes or more
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.monocular $(MOCAP) --python $(VENV)/monocular/bin/python

MOCAP ?= cmu_mocap
STEPS ?= 20000
UNSEEN = $(MOCAP)/bvh/131_01.bvh $(wildcard $(MOCAP)/bvh_from_expmap/test_*.bvh)
WEAR   = $(BIN)/caphy train caphy/data/garments/$(1).npz $(MOCAP)/bvh $(MOCAP)/bvh_from_expmap \
	--held-out $(UNSEEN) --made-up 12 --steps $(STEPS) -o runs/$(1)
avatar: $(VENV)/.dev           ## train the bundled default avatar again: make -j2 avatar MOCAP=folder-of-CMU-clips; resumes
	$(MAKE) runs/trousers/.trained runs/tshirt/.trained
	$(MAKE) runs/collided/.trained
	$(MAKE) runs/collided/trousers/validation.json runs/collided/tshirt/validation.json
	$(BIN)/caphy export runs/collided/trousers runs/collided/tshirt -o caphy/data/avatars/default

# one core for each garment
runs/%: export OMP_NUM_THREADS = 1
RESUME = $(if $(wildcard $(@D)/checkpoint.safetensors),--resume)
runs/collided/.trained:
	$(BIN)/caphy collide runs/trousers runs/tshirt -o $(@D) $(RESUME)
	touch $@
runs/%/.trained:
	$(call WEAR,$*) $(RESUME)
	touch $@
runs/collided/%/validation.json:
	$(BIN)/caphy validate $(@D) --seconds 0.25

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

$(VENV)/.node: $(VENV)/.python service/viewer/package.json
	mkdir -p $(VENV)/node
	cp service/viewer/package.json $(VENV)/node/
	npm install --prefix $(VENV)/node --no-package-lock --no-audit --no-fund --silent
	touch $@

# mediapipe wants numpy 1 and the rest numpy 2, hence an environment of its own.
$(VENV)/.monocular: $(VENV)/.python service/clients/monocular/requirements.txt
	$(PYTHON) -m venv $(VENV)/monocular
	$(VENV)/monocular/bin/pip install --quiet -r service/clients/monocular/requirements.txt
	touch $@

clean:
	rm -rf $(VENV) build dist demo-out *.egg-info
