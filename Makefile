# Everything here needs Python 3.11 or newer and make; no root, no system packages.
#   make demo     bake, train and measure the built-in scene, then say how to ask it for a frame
#   make test     the whole gate: make check, then the tests
#   make check    lint, format, types, layering
#   make format   put the code into the house format
#   make benchmarks SCENES="a.xml tabletop"   measure scenes and write docs/benchmarks.md of all measured so far
#   make torture  kill workers, scheduler, service and trainer at random for a quarter of an hour; compare every byte
#   make clean    remove the environment and what the tools left

# The CPU build of torch is the default. For the build of your package index (CUDA on Linux): make TORCH=any ...
TORCH ?= cpu
PYTHON ?= $(shell command -v python3.11 || command -v python3)

# What `make benchmarks` measures, where it keeps the results, and further options (--size 1280x720, --ablate).
SCENES ?= tabletop
STORE ?= ./store
BENCHMARK_OPTIONS ?= --preset draft --resolution 256x256

BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
CONSTRAINTS := -c constraints.txt $(if $(filter cpu,$(TORCH)),-c constraints-cpu.txt)

.PHONY: demo test check format benchmarks torture clean venv
.DELETE_ON_ERROR:

demo: .venv/.ready
	$(BIN)/lightwell demo $(DEMO_OPTIONS)

test: check
	$(BIN)/python -m pytest -q

check: .venv/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q tests/test_layers.py

format: .venv/.ready
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmarks: .venv/.ready
	$(BIN)/lightwell benchmark --store $(STORE) --output docs/benchmarks.md \
	  $(foreach scene,$(SCENES),--scene $(scene)) $(BENCHMARK_OPTIONS)

torture: .venv/.ready
	$(BIN)/python -m tests.torture.torture $(TORTURE_OPTIONS)

venv: .venv/.ready

# stlpips_pytorch is read as data (its network weights), never imported: --no-deps leaves its torchvision out.
.venv/.ready: pyproject.toml constraints.txt constraints-cpu.txt
	@test -n "$(PYTHON)" || { echo "make: Python 3.11 or newer must be installed, found none; set PYTHON=/path/to/python3.11" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else "make: Python must be 3.11 or newer, got %d.%d; set PYTHON=/path/to/python3.11" % v[:2])'
	"$(PYTHON)" -m venv .venv
	$(PIP) install --quiet -c constraints.txt pip
	@$(PIP) install --quiet $(CONSTRAINTS) --build-constraint constraints.txt -e '.[test]' || { \
	  echo "make: the packages must install, see pip's message above." >&2; \
	  echo "      If it names torch and cuda-toolkit: your package index has only the CUDA build of torch. Add PyTorch's" >&2; \
	  echo "      index of CPU wheels (pytorch.org, Get Started, Pip, CPU) as PIP_EXTRA_INDEX_URL, or accept several GB" >&2; \
	  echo "      of CUDA packages with TORCH=any; then run make again." >&2; \
	  exit 1; }
	$(PIP) install --quiet -c constraints.txt --no-deps stlpips_pytorch
	@touch $@

clean:
	rm -rf .venv .mypy_cache .pytest_cache .ruff_cache .hypothesis build *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
