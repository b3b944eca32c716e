# relit: `make demo` and `make test` from a clean clone need Python 3.11 or newer (with its venv module) and make.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# tests of the service wait much of their time, so that three share two cores well; each process loads all modules first
WORKERS ?= 3
# Python keeps what it compiled, also where an image says that it should not: else every start of a program compiles all of it again
export PYTHONDONTWRITEBYTECODE :=
# as the program sets it: with more threads than cores, matrices wait for each other
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q -n $(WORKERS) --no-loadscope-reorder
EMULATED := OPENBLAS_NUM_THREADS=1 nice $(BIN)/python -m pytest -q -n 2 --device-emulated -m "not long" tests/kernels tests/test_device_ways.py \
  tests/test_gpu_benchmark.py tests/service/sharing

.PHONY: demo serve test test-all compiled clients lint bench gpu-bench manifest-page figures samples screenshots lock vendor colour-table clean
demo: $(VENV)/installed
	$(BIN)/relit demo

serve: $(VENV)/installed
	$(BIN)/relit demo --serve

test: $(VENV)/installed-dev
	$(PYTEST) -m "not long"

# with the long suites: workers and servers killed, databases restarted, load, random requests, calibrations of statistics, pages, CUDA builds
# and the kernels and products as on a GPU, on an emulated one, which takes what the others, who often wait, leave of the processors;
# PART=2 takes of the long tests those of the third part of twenty alone, and of those on the emulated device those of the third part of six
test-all: $(VENV)/installed-dev
	$(EMULATED) $(if $(PART),--part=$(PART)) >$(VENV)/emulated.log 2>&1 & emulated=$$!; \
	  $(PYTEST) --durations=60 $(if $(PART),--part=$(PART)); tests=$$?; \
	  wait $$emulated || tests=$$?; cat $(VENV)/emulated.log; exit $$tests

# keeps what Python compiles of modules and tests
compiled: $(VENV)/installed-dev
	$(BIN)/python -m pytest -q --collect-only >/dev/null

# Blender, Mitsuba and three.js, which tests/clients opens assets with; needs Python 3.11 exactly, npm, and Chromium beside it.
# OpenLIME too, where the registry has it: not all do
clients: .clients/installed

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: $(VENV)/installed
	$(BIN)/relit bench

# the kernels on cuda:0, compared with NumPy and then timed; needs nothing but Warp and NumPy: python -m benchmarks.gpu in any environment with them
gpu-bench: $(VENV)/installed
	$(BIN)/python -m benchmarks.gpu

# docs/manifest.md, every field of capture.json, from the models in stage/
manifest-page: $(VENV)/installed-dev
	$(BIN)/python -m docs.tools.manifest_page

# the tables of docs/figures.md; FIGURES="--data DIR --glossy DIR --large DIR" measures what needs data or space
figures: $(VENV)/installed-dev
	$(BIN)/python -m benchmarks.figures $(FIGURES)

# render the sample captures again (tens of minutes; Mitsuba is installed for it)
samples: $(VENV)/installed-dev
	$(BIN)/python -m pip install --quiet -e '.[samples]'
	$(BIN)/python samples/make_owl.py
	$(BIN)/python samples/make_lambert.py
	$(BIN)/python samples/make_rig.py --sample

# the pictures of the pages in docs/, by the tests that make them (needs Chromium)
screenshots: $(VENV)/installed-dev
	RELIT_TEST_SCREENSHOTS=$(CURDIR)/docs $(BIN)/python -m pytest -q tests/service/server/pages/test_sample_pages.py tests/service/server/pages/test_twin_page.py \
	  tests/service/server/pages/test_home_page.py tests/service/server/pages/test_machines_page.py \
	  tests/service/server/pages/test_set_page.py tests/service/server/pages/test_published_page.py -k "shows_the_sample or to_an_asset or a_fault_is_named_and_mended"
	$(BIN)/python -m docs.tools.chart_picture
	$(BIN)/python -m docs.tools.view_picture

# the lock records versions and hashes, and no download address
lock:
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-annotate \
	  --custom-compile-command "make lock" --extra build --extra scans pyproject.toml -o requirements.lock
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-annotate \
	  --custom-compile-command "make lock" --extra build --extra dev pyproject.toml -o requirements-dev.lock
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-annotate \
	  --custom-compile-command "make lock" tests/clients/requirements.in -o tests/clients/requirements.lock
	cd tests/clients && npm install --silent --package-lock-only --omit-lockfile-registry-resolved

# the files of three.js that the pages load, of the version that tests/clients locks; needs npm. VENDORED/SHA256SUMS says which files
VENDORED = service/server/pages/static/vendor/three
vendor:
	rm -rf .vendor && mkdir .vendor && cp tests/clients/package.json tests/clients/package-lock.json .vendor
	cd .vendor && npm ci --silent --no-audit --no-fund --ignore-scripts
	cd $(VENDORED) && awk '{print $$2}' SHA256SUMS | while read -r file; do \
	  case $$file in LICENSE) from=LICENSE;; addons/*) from=examples/jsm/$${file#addons/};; *) from=build/$$file;; esac; \
	  install -D -m 644 "$(CURDIR)/.vendor/node_modules/three/$$from" "$$file" || exit 1; done
	cd $(VENDORED) && sha256sum $$(awk '{print $$2}' SHA256SUMS) > SHA256SUMS.new && mv SHA256SUMS.new SHA256SUMS
	rm -rf .vendor

# the colour spaces that pages convert between, as the colour library has them
colour-table: $(VENV)/installed
	$(BIN)/python -m docs.tools.colour_table > service/server/pages/static/view/colour_table.js.new
	mv service/server/pages/static/view/colour_table.js.new service/server/pages/static/view/colour_table.js
	$(BIN)/python -m docs.tools.view_table > service/server/pages/static/view/aces.bin.new
	mv service/server/pages/static/view/aces.bin.new service/server/pages/static/view/aces.bin

clean:
	rm -rf $(VENV) .clients relit-demo

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit("relit needs Python 3.11 or newer: make PYTHON=python3.11 ...") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV) || (rm -rf $(VENV); echo "the venv module is missing: on Debian, apt-get install python3-venv"; exit 1)

OPENLIME := openlime@1.2.6
.clients/installed: tests/clients/requirements.lock tests/clients/package-lock.json
	$(PYTHON) -c 'import sys; sys.exit("bpy needs Python 3.11: make clients PYTHON=python3.11") if sys.version_info[:2] != (3, 11) else None'
	$(PYTHON) -m venv .clients
	.clients/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r tests/clients/requirements.lock
	cp tests/clients/package.json tests/clients/package-lock.json .clients
	cd .clients && npm ci --silent --no-audit --no-fund
	cd .clients && npm install --silent --no-audit --no-fund --no-save --ignore-scripts $(OPENLIME) \
	  || echo "$(OPENLIME) is not to be had from npm's registry here: what relit publish --as openlime writes is not opened with it"
	touch $@

$(VENV)/installed: requirements.lock pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

$(VENV)/installed-dev: requirements-dev.lock pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-dev.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@ $(VENV)/installed
