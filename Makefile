# kgcp: every target does its own set-up, in .venv of this folder. `make` alone lists the targets.

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
MINIMUM := (3, 11)
CANDIDATES := $(or $(PYTHON),python3 python3.13 python3.12 python3.11 python)

.DEFAULT_GOAL := help
.PHONY: help demo test check lint types format bench-aat bench-accuracy bench-search bench-speed soak torture fuzz sample-flight first-flights dist clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: $(VENV)/.runs ## detect, export-gcp and bias-report on sample_flight/
	$(BIN)/kgcp detect sample_flight
	$(BIN)/kgcp export-gcp sample_flight
	$(BIN)/kgcp bias-report sample_flight
	@echo
	@echo "The results are in sample_flight/kgcp:"
	@ls -1 sample_flight/kgcp | sed 's/^/  /'
	@echo "Open sample_flight/kgcp/bias_report.html in a browser."

# the tests start hundreds of processes: each would compile all modules anew
test: export PYTHONDONTWRITEBYTECODE :=
test: $(VENV)/.develops ## run the tests
	$(BIN)/python -m pytest -n auto --dist worksteal

check: lint types test ## everything that must pass before a change is merged

lint: $(VENV)/.develops ## check style and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.develops ## check the type annotations, also for Windows and macOS
	$(BIN)/mypy
	$(BIN)/mypy --platform win32 kgcp
	$(BIN)/mypy --platform darwin kgcp

format: $(VENV)/.develops ## format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench-accuracy: $(VENV)/.runs ## errors on simulated flights, against reported accuracy and bound (minutes)
	$(BIN)/python -m benchmarks.accuracy.presets $(BENCH)

PHOTOS := ../shared/real

bench-search: $(VENV)/.runs ## targets found, missed and mistaken in hard frames and photographs (half an hour)
	$(BIN)/python -m benchmarks.search.hard_frames $(BENCH)
	$(BIN)/python -m benchmarks.search.false_alarms $(PHOTOS)

first-flights: $(VENV)/.runs ## record docs/first_flight_runs.md anew (a minute)
	$(BIN)/python -m benchmarks.first_flight.runs --write

bench-speed: $(VENV)/.runs ## time of search and detection relative to decoding, and memory (minutes)
	$(BIN)/python -m benchmarks.speed.relative_costs --flights ../shared/flights --photos $(PHOTOS) $(BENCH)

bench-aat: $(VENV)/.runs ## how much KGCPs improve a simulated adjustment: table, figure (ten minutes)
	$(PIP) --editable '.[aat]'
	$(BIN)/python -m benchmarks.aat.benefit --figure docs/aat_benefit.png $(BENCH)

torture: $(VENV)/.runs ## kill detect and its workers 50 times over 2 000 frames (a quarter of an hour)
	$(BIN)/python -m benchmarks.reliability.torture $(BENCH)

soak: $(VENV)/.runs ## memory and speed of detect over 20 000 small frames (a quarter of an hour)
	$(BIN)/python -m benchmarks.reliability.soak $(BENCH)

FUZZ_SECONDS ?= 300

fuzz: $(VENV)/.runs ## search for files that break a reader, FUZZ_SECONDS for each kind (half an hour)
	$(PIP) --editable '.[fuzz]'
	$(BIN)/python -m fuzz --seconds $(FUZZ_SECONDS) $(FUZZ)

sample-flight: $(VENV)/.runs ## make sample_flight/ again, byte for byte
	rm -rf sample_flight
	$(BIN)/kgcp simulate sample_flight --preset sample

dist: $(BIN)/python ## build wheel and sdist in dist/
	$(PIP) build
	$(BIN)/python -m build --outdir dist .

clean: ## remove results and caches (the virtual environment stays)
	rm -rf sample_flight/kgcp build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

# The stamps say what has been installed for which pyproject.toml.
$(VENV)/.develops: pyproject.toml | $(BIN)/python
	$(PIP) --editable '.[dev]'
	@touch $@ $(VENV)/.runs

$(VENV)/.runs: pyproject.toml | $(BIN)/python
	$(PIP) --editable .
	@touch $@

$(BIN)/python:
	@for python in $(CANDIDATES); do \
	  if $$python -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < $(MINIMUM))' \
	      2> /dev/null; then \
	    echo "$$python -m venv $(VENV)"; exec $$python -m venv $(VENV); \
	  fi; \
	done; \
	echo "kgcp needs Python 3.11 or newer with venv and pip;" \
	  "install it, or name it: make PYTHON=/path/to/python3.11" >&2; \
	exit 1
