#!/bin/sh
# What a container runs. exec: the server takes the place of this shell, so that SIGTERM reaches it and it drains.
# 2>&1: a container's output is its log, all of it JSON and without the token.
set -eu
cd "$(dirname "$0")/.."
exec .venv/bin/probeless serve --host 0.0.0.0 --port "${PROBELESS_PORT:-8080}" --log json "$@" 2>&1
