#!/bin/sh
# A cluster of two nodes on this machine, to try it: a socket at port 8000, four places for rooms on each node.
# Needs PROBELESS_TOKEN (or none) or PROBELESS_TOKEN_FILE, and what `make install-cluster` installs. Ctrl-C or SIGTERM ends all of it.
set -eu
cd "$(dirname "$0")/../.."
test -z "${PROBELESS_TOKEN_FILE:-}" || PROBELESS_TOKEN=$(cat "$PROBELESS_TOKEN_FILE")
: "${PROBELESS_TOKEN:?set it to a secret of yours (openssl rand -hex 24), or to none to let everybody in}"
export PROBELESS_TOKEN RAY_SERVE_ENABLE_HA_PROXY="${RAY_SERVE_ENABLE_HA_PROXY:-1}" RAY_USAGE_STATS_ENABLED=0
# A node that is silent for about five seconds is dead.
export RAY_health_check_period_ms=1000 RAY_health_check_timeout_ms=2000 RAY_health_check_failure_threshold=3
PORT=6399
BIN=.venv/bin

end() {
    trap - INT TERM EXIT
    # Rooms were saved two seconds ago. A shell's background processes do not hear Ctrl-C.
    for process in ${serving:-} ${second:-} ${first:-}; do
        kill "$process" 2> /dev/null || true
        wait "$process" || true
    done
}

trap end INT TERM EXIT
$BIN/ray start --block --head --port="$PORT" --num-cpus=2 --resources='{"room": 4}' --include-dashboard=false &
first=$!
until $BIN/ray health-check --address "127.0.0.1:$PORT" > /dev/null 2>&1; do sleep 1; done
$BIN/ray start --block --address="127.0.0.1:$PORT" --num-cpus=2 --resources='{"room": 4}' &
second=$!
RAY_ADDRESS="127.0.0.1:$PORT" $BIN/serve run docker/cluster/local.yaml &
serving=$!
wait "$serving" || true
