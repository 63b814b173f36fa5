# Two commands do all the set-up on a fresh machine:  make demo  and  make test
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT := out
JOBS ?= $(shell n=$$(nproc); echo $$((n < 4 ? n : 4)))
# tests run side by side: threads of one would spin while the other's work
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n $(JOBS) --dist loadgroup

.PHONY: coverage demo docs nightly test test-slow check check-mypy check-rest fix clean

demo: $(VENV)/.demo  ## compress the driver that ships, drive before and after
	$(BIN)/me2e-compress demo -o $(OUT)

test: check  ## lint, types, layers, tests
	$(PYTEST)

test-slow: $(VENV)/.test  ## what takes minutes: TensorRT-RTX builds of whole stacks, training killed and resumed, 2 GB
	$(PYTEST) -m slow

nightly: $(VENV)/.test  ## an hour: exact passes on 20,000 drawn graphs; resumes from out/nightly; FIRST=seed GRAPHS=count
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.fuzz.exact --graphs $(or $(GRAPHS),20000) --jobs $(JOBS) --first $(or $(FIRST),0) --out $(OUT)/nightly

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

$(VENV)/.test: pyproject.toml constraints.txt | $(VENV)
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[zoo,highway,fast,bench,ray,trt-check,test]'
	touch $@ $(VENV)/.demo

$(VENV)/.docs: pyproject.toml constraints.txt | $(VENV)
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[zoo,highway,fast,ray,docs]'
	touch $@

$(VENV):
	$(PYTHON) -m venv $(VENV)

clean:
	rm -rf $(VENV) $(OUT)
