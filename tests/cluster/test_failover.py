"""With Ray: a node is killed or drained, and its rooms come back; clients that have left get none."""

import importlib.util
import json
import subprocess
import sys
from typing import Any

import pytest

PATIENCE_S = 1500.0
"""A longer run is taken to hang. The time until rooms are back is a figure of docker/README.md (goal: 30 s)."""


pytestmark = [
    pytest.mark.cluster,
    pytest.mark.skipif(
        importlib.util.find_spec("ray") is None or importlib.util.find_spec("grpc") is None,
        reason="needs the extra cluster: make install-cluster",
    ),
]


def played(module: str) -> dict[str, Any]:
    """What a program of two nodes prints."""
    done = subprocess.run(
        [sys.executable, "-m", module], check=False, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr[-4000:]
    result: dict[str, Any] = json.loads(done.stdout[done.stdout.index("{") :])
    return result


def test_clients_that_leave_at_once_keep_no_place_and_rooms_of_a_drained_node_move() -> None:
    result = played("tests.cluster.draining")
    assert result["opened_for_nobody"] == 0
    assert result["left_open"] == 0
    assert result["drain_status"] == 0
    assert result["rooms_of_the_node"] == 1
    assert result["moved"]
    assert result["object_kept"]


def test_rooms_of_a_node_that_is_killed_are_back_on_the_other_one() -> None:
    result = played("tests.cluster.failover")
    assert len(result["rooms"]) == 4
    assert result["rooms_of_the_killed_node"] >= 1
    for room in result["rooms"]:
        assert room["object_kept"], room
        assert (room["back_s"] is not None) == room["moved"], room
        assert room["longest_pause_s"] is not None, room
        assert room["reconnected"] == (1 if room["moved"] else 0)
