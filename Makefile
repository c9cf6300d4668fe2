# Every target sets up what it needs in .venv first; the second time that takes no time.
PYTHON ?= python3
BIN := .venv/bin
DATA ?= ../shared/data

.PHONY: help install install-bench install-cluster install-oak install-video demo test lint bench check-races web package lock clean
help:
	@echo "make demo    the main job: server, streaming client, pictures in out/demo"
	@echo "make test    the tests           make lint   formatting, types"
	@echo "make bench   the benchmarks      make web    rebuild the page from its sources"
	@echo "make package the npm package of client/web, into out"
	@echo "make check-races   the kernels in a simulator that finds data races (downloads it)"
	@echo "make install the program alone, as .venv/bin/probeless; install-cluster: and Ray Serve, for many machines"
	@echo "make install-oak   that, and what reads an OAK camera; install-video: what reads and writes H.264"

install: .venv/installed
install-bench: .venv/installed-bench
install-cluster: .venv/installed-cluster
install-oak: .venv/installed-oak
install-video: .venv/installed-video

demo: .venv/installed
	$(BIN)/probeless demo

# What only computes runs side by side; sockets and browsers have the machine to themselves.
ALONE := tests/client tests/cluster tests/docker tests/service
test: export PROBELESS_DATA := $(or $(PROBELESS_DATA),$(DATA))
test: .venv/installed-test
ifdef TESTS
	$(BIN)/python -m pytest $(TESTS)
else
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile $(ALONE:%=--ignore=%)
	$(BIN)/python -m pytest $(ALONE)
endif

lint: .venv/installed-test
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

# Each suite measures, then writes its page of docs/benchmarks with the commit and the date.
SUITES := geometry light rendering accuracy plan stability service client
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

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "probeless needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1): make PYTHON=python3.12 ..."; exit 1; }
	$(PYTHON) -m venv .venv

.venv/installed: requirements.lock pyproject.toml | .venv/bin/python
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

.venv/installed-test: requirements-test.lock .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-test.lock
	@touch $@

.venv/installed-oak: requirements-oak.lock .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-oak.lock
	@touch $@

.venv/installed-video: requirements-video.lock .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-video.lock
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
