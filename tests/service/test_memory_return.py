"""Memory goes back to the system once sessions have ended, once for several."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading

import pytest

from server.service.memory_return import MemoryReturn
from tests.data import ROOT

HELD = """
import sys, threading
sys.path.insert(0, sys.argv[1])
from server.service.memory_return import give_back_freed

def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6

kept = []
def use():  # as a session's thread: much is freed, and what stays lies above it
    blocks = [bytes(50_000) for _ in range(2000)]
    kept.append(blocks[-1])
threads = [threading.Thread(target=use) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
before = resident_mb()
give_back_freed()
print(before - resident_mb())
"""


def test_sessions_that_end_together_share_one_return() -> None:
    returns: list[str] = []

    async def sessions() -> None:
        memory = MemoryReturn(lambda: returns.append(threading.current_thread().name), pause_s=0.01)
        for _ in range(2):
            for _ in range(3):
                memory.note_end()
            await asyncio.sleep(0)
            assert memory._due is not None
            await memory._due
        memory.note_end()
        memory.stop()
        await asyncio.gather(memory._due, return_exceptions=True)

    asyncio.run(sessions())
    assert len(returns) == 2
    assert threading.main_thread().name not in returns


@pytest.mark.skipif(sys.platform != "linux", reason="this machine's hardware: only glibc keeps freed memory so")
def test_what_threads_have_freed_is_given_back() -> None:
    done = subprocess.run([sys.executable, "-c", HELD, str(ROOT)], capture_output=True, text=True, check=True)
    assert float(done.stdout) > 20.0, "MB, of 400 that were used and freed"
