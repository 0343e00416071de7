# `make help` lists what there is to do. Everything is installed into .venv and nowhere else.
SHELL := /bin/bash
.DEFAULT_GOAL := help
PYTHON ?= python3
WORKERS ?= 2
BIN := .venv/bin

# The pins hold for the build of this package too, not only for what is installed.
export PIP_CONSTRAINT := constraints.txt
export PIP_BUILD_CONSTRAINT := constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1

RECENT := import sys; sys.exit(sys.version_info < (3, 11))

# An incomplete or moved environment, or one without its interpreter, is created again.
SOUND := $(shell [ -e .venv/.made ] && [ ! -e .venv/.installing ] \
	&& [ "$$(cat .venv/.made)" = "$(CURDIR)" ] \
	&& $(BIN)/python -c 'import pip; $(RECENT)' 2>/dev/null && echo yes)

.NOTPARALLEL: # two installs into one environment would meet

.PHONY: help
help: ## list the targets
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 16

.PHONY: demo
demo: .venv/.sim ## install, then run the demo into runs/demo
	$(BIN)/offbeat demo --out runs/demo

.PHONY: test
test: .venv/.test ## install, then run all tests
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal --durations=10 $(PYTEST_ARGS)

.PHONY: check
check: .venv/.test ## install, then lint, check the format and the types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

.PHONY: docs
docs: .venv/.test ## install, then build the documentation site into site/, without a warning
	$(BIN)/zensical build --strict

MUTANTS ?= 1000

.PHONY: fuzz
fuzz: .venv/.test ## read MUTANTS damaged files of every format
	OMP_NUM_THREADS=1 $(BIN)/python tests/fuzz.py --mutants $(MUTANTS)

KILLS ?= 200

.PHONY: torture
torture: .venv/.test ## kill commands at KILLS random file operations, and resume them
	OMP_NUM_THREADS=1 $(BIN)/python tests/torture.py --kills $(KILLS)

# The kernel's tests with the address and undefined-behaviour sanitizers, in a build of its own.
SANITIZED := build/sanitized
RUNTIME = $(shell $(CXX) -print-file-name=libasan.so) $(shell $(CXX) -print-file-name=libstdc++.so)

.PHONY: sanitize
sanitize: .venv/.test ## build the kernel with sanitizers, then run its tests
	$(BIN)/python -m pip install -qq cmake nanobind ninja
	$(BIN)/cmake -S . -B $(SANITIZED) -G Ninja -DCMAKE_MAKE_PROGRAM=$(CURDIR)/$(BIN)/ninja \
		-DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python -DOFFBEAT_SANITIZE=ON -DCMAKE_BUILD_TYPE=Release
	$(BIN)/cmake --build $(SANITIZED)
	LD_PRELOAD="$(RUNTIME)" ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=halt_on_error=1 \
		OMP_NUM_THREADS=1 OFFBEAT_TEST_CPU=$(CURDIR)/$(SANITIZED) \
		$(BIN)/python -m pytest tests/test_kernel_limits.py tests/test_compiled_optimizer.py \
		tests/test_kernels.py tests/test_cpu_engine.py tests/test_stream_in_order.py -n $(WORKERS) --timeout=1200 $(PYTEST_ARGS)

.PHONY: clean
clean: ## remove .venv and everything that was built or cached
	rm -rf .venv build dist site .cache .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find src tests -name __pycache__ -prune -exec rm -rf {} +

.venv/.made:
	@command -v "$(PYTHON)" >/dev/null || { \
		echo "$(PYTHON) was not found; name Python 3.11 or later: make PYTHON=python3.12" >&2; exit 1; }
	@"$(PYTHON)" -c '$(RECENT)' || { \
		echo "Offbeat needs Python 3.11 or later, but $(PYTHON) is $$("$(PYTHON)" --version 2>&1);" \
			"name another: make PYTHON=python3.12" >&2; exit 1; }
	rm -rf .venv
	"$(PYTHON)" -m venv .venv
	@echo "$(CURDIR)" > $@

# Torch goes first: with it in place, nothing else can bring another build of it.
define install
	@echo "Installing into .venv (some minutes the first time)"
	@touch .venv/.installing
	$(BIN)/python -m pip install -qq torch
	$(BIN)/python -m pip install -qq --editable '.[$(1)]'
	@echo "$(MODULES)" > .venv/.modules
	@rm .venv/.installing
endef

SOURCES := pyproject.toml constraints.txt CMakeLists.txt $(wildcard csrc/* csrc/*/*)

# An editable installation holds a list of the modules: install again where one came, went or moved.
MODULES := $(shell find src -name '*.py' | LC_ALL=C sort | cksum)
ifneq ($(MODULES),$(shell cat .venv/.modules 2>/dev/null))
$(shell rm -f .venv/.sim .venv/.test)
endif

.venv/.sim: .venv/.made $(SOURCES)
	$(call install,sim)
	@touch $@

.venv/.test: .venv/.made $(SOURCES)
	$(call install,test)
	@touch .venv/.sim $@ # what the tests need holds what the demo needs

ifneq ($(SOUND),yes)
.PHONY: .venv/.made
endif
