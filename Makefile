# Two commands do all the set-up on a fresh machine:  make demo  and  make test
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT := out
NEWEST ?= python3.13
WORKS := demo,frames,compress,compare,plan,lint,calibrate,profile,evaluate,score,study
JOBS ?= $(shell n=$$(nproc); echo $$((n < 4 ? n : 4)))
# tests run side by side: threads of one would spin while the other's work
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n $(JOBS) --dist loadgroup

.PHONY: coverage demo docs newest nightly replay test test-slow check check-mypy check-rest fix clean

demo: $(VENV)/.demo  ## compress the driver that ships, drive before and after
	$(BIN)/me2e-compress demo -o $(OUT)

test: check  ## lint, types, layers, tests
	$(PYTEST)

test-slow: $(VENV)/.test  ## what takes minutes: TensorRT-RTX builds of whole stacks, training killed and resumed, 2 GB
	$(PYTEST) -m slow

nightly: $(VENV)/.test  ## hours: all that make test leaves out; FIRST=seed GRAPHS=count of the drawn graphs
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.fuzz.exact --graphs $(or $(GRAPHS),20000) --jobs $(JOBS) --first $(or $(FIRST),0)
	$(PYTEST) -m "slow or not slow" --hypothesis-profile=night --cov --cov-report=term:skip-covered
	$(MAKE) --no-print-directory docs
	$(MAKE) --no-print-directory newest

replay: $(VENV)/.test  ## do the last tag (or BASE=commit) and this checkout write the same files?
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.tools.replay $(if $(BASE),--base $(BASE))

newest:  ## every command, with the newest Python that is tested
	rm -rf $(OUT)/newest && $(NEWEST) -m venv $(OUT)/newest && git clone -q . $(OUT)/newest/source
	$(OUT)/newest/bin/pip install -q -c constraints.txt "$(OUT)/newest/source[highway,fast]"
	$(OUT)/newest/bin/python .ci/try_commands.py --works $(WORKS) --without sensitivity,search

coverage: $(VENV)/.test  ## the same tests, with branch coverage and its floor
	$(PYTEST) --cov --cov-report=term:skip-covered

docs: $(VENV)/.docs  ## the API reference, from the docstrings
	$(BIN)/python docs/make_api.py out/api

check: $(VENV)/.test  ## mypy beside the others: each takes one core
	$(MAKE) --no-print-directory --output-sync -j 2 check-mypy check-rest

check-mypy:
	$(BIN)/mypy

check-rest:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

fix: $(VENV)/.test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(VENV)/.demo: pyproject.toml constraints.txt | $(VENV)
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[highway,fast]'
	touch $@

$(VENV)/.test: pyproject.toml constraints.txt models/requirements.txt | $(VENV)
	$(BIN)/python -m pip install -q -c constraints.txt -r models/requirements.txt -e '.[highway,fast,bench,ray,openvino,trt-check,test]'
	touch $@ $(VENV)/.demo

$(VENV)/.docs: pyproject.toml constraints.txt | $(VENV)
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[highway,fast,ray,docs]'
	touch $@

$(VENV):
	$(PYTHON) -m venv $(VENV)

clean:
	rm -rf $(VENV) $(OUT)
