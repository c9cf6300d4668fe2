"""How old a frame is when a browser shows its answer: the page's own figures, with a device of WebXR that is made up.

Chromium draws on the processors that the server computes on.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from tests.bench.client.bandwidth import kitchen
from tests.bench.client.latency import LINKS
from tests.bench.report.finished import Part, UnmeasurableError
from tests.bench.report.run import Run
from tests.bench.service.process import serving

QUICK_ANSWERS, ANSWERS = 30, 100
SEQUENCE = 8
"""Frames that the device shows, there and back."""
SHOWN_LINKS = ("loopback", "40 ms and 10 Mbit/s", "40 ms and 2 Mbit/s")
STAGES = {
    "packed": "captured to sent",
    "answered": "sent to answered",
    "computed": "of it, the server's stages",
    "shown": "answered to shown",
    "all": "captured to shown",
}
WEB = Path(__file__).resolve().parents[2] / "client" / "web"
PATIENCE_MS = 120_000
OBSERVE = """() => {
  const stages = ["packed", "answered", "computed", "shown", "all"];
  const read = (stage) => [stage, Number(document.getElementById(`latency-${stage}`).textContent)];
  const note = () => window.answers.push({ at: performance.now(), ...Object.fromEntries(stages.map(read)) });
  const observer = new MutationObserver(note);
  window.answers = [];
  observer.observe(document.getElementById("latency-all"), { childList: true, characterData: true, subtree: true });
  document.getElementById("start").addEventListener("click", () => (window.began = performance.now()), { once: true });
}"""


def browser_part(run: Run, _out: Path) -> Part:
    """Of the kitchen, GR15FAST. Raises UnmeasurableError where there is no Chromium."""
    part, count = Part(), run.of(QUICK_ANSWERS, ANSWERS)
    part.sizes["answers in a browser"] = count
    device = _device()
    with TemporaryDirectory() as folder, serving(Path(folder) / "log") as served, chromium() as browser:
        for name in SHOWN_LINKS:
            run.say(f"a browser, {name}: {count} answers")
            with LINKS[name].to(served) as url:
                _answers(browser, url, device, 10)  # kernels and pages are warm
                _add(part, f"browser, {name}", *_answers(browser, url, device, count))
    return part


def _device() -> dict[str, Any]:
    from tests.client.web.sequence import of_device

    source = kitchen()
    frames = [source[place] for place in range(0, 4 * SEQUENCE, 4)]
    return of_device(source.camera, [*frames, *frames[-2:0:-1]], loops=True)


@contextmanager
def chromium() -> Iterator[Any]:
    """Debian's, without a window. Raises UnmeasurableError where there is none."""
    program = shutil.which("chromium")
    if program is None:
        raise UnmeasurableError("there is no chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise UnmeasurableError("there is no playwright (make install-bench)") from error
    from tests.client.web.conftest import FLAGS

    own = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=[*FLAGS, *own])
        yield browser
        browser.close()


def _answers(browser: Any, url: str, device: dict[str, Any], count: int) -> tuple[float, list[dict[str, float]]]:
    """Seconds from the button to the first picture, and the page's figures of each answer."""
    context = browser.new_context(viewport={"width": 900, "height": 700})
    try:
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.add_init_script(path=WEB / "device.js")
        page.goto(url)
        page.evaluate("given => device.load(given)", device)
        page.evaluate(OBSERVE)
        page.locator("input[name=source][value=xr]").check()
        page.locator("select[name=preset]").select_option("gr15fast")
        page.locator("#start").click()
        page.wait_for_function("count => window.answers.length >= count", arg=count, timeout=PATIENCE_MS)
        found = page.evaluate("() => ({ began: window.began, answers: window.answers })")
    finally:
        context.close()
    return (found["answers"][0]["at"] - found["began"]) / 1e3, found["answers"]


def _add(part: Part, link: str, first_s: float, answers: list[dict[str, float]]) -> None:
    rate = 1e3 * (len(answers) - 1) / (answers[-1]["at"] - answers[0]["at"])
    part.add(f"{link}: shown", rate, "frames/s")
    part.add(f"{link}: first picture, from the button", first_s, "s")
    for stage, name in STAGES.items():
        values = [answer[stage] for answer in answers]
        part.add(f"{link}: {name}, p50", float(np.percentile(values, 50)), "ms")
        part.add(f"{link}: {name}, p99", float(np.percentile(values, 99)), "ms")
