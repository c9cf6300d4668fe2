"""Layer mode: what layers take on the wire, how old the picture on the screen is, where virtual things are in it.

The screen is Chromium's with a made-up device of WebXR whose camera turns above the synthetic table; it draws on the
processors that the server computes on.
"""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from client.sources.frame_source import Source
from protocol.codec import encode
from protocol.images import encode_color, encode_depth
from protocol.messages import Frame
from server.client_session import ClientSession
from server.pipeline import FrameResult
from server.scene.mesh import load_mesh
from server.scene.placement import Placement
from server.scene.vase import vase_glb
from server.service.result_encoding import JPEG_QUALITY, layer_message
from tests.bench.client.bandwidth import FPS, kitchen
from tests.bench.client.browser import PATIENCE_MS, WEB, chromium
from tests.bench.light.runs import wishes_for
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.service.speed import looked_at
from tests.service.proxy import impaired

QUICK_FRAMES, FRAMES = 10, 40
"""On the wire, spread over the kitchen's."""
QUICK_DISPLAYED, DISPLAYED = 100, 500
BATCH = 50
"""Display frames that are read from the page at once."""
SIZE, REACH_DEG, STEP_DEG = (320, 240), 8.0, 0.5
DELAY_S = 0.15
"""Each way: an answer takes 300 ms more than the server."""
SETTLING_MS = 3000


def layer_wire_part(run: Run, _out: Path) -> Part:
    """Of the kitchen with a vase, REG4, as a browser gets them."""
    source, count = kitchen(), run.of(QUICK_FRAMES, FRAMES)
    part = Part(sizes={"frames of layers on the wire": count})
    wishes = msgspec.structs.replace(wishes_for(source, range(len(source))), preset="reg4", answer="layer")
    pipeline = ClientSession(run.device, source.camera, wishes)
    x, y, z = looked_at(source[0], source.camera.depth_scale_m).tolist()
    pipeline.place_object("vase", load_mesh(vase_glb(), "glb"), Placement(position_m=(x, y, z), scale=1.0, yaw_deg=0.0))
    try:
        found = [_sizes(source, index, pipeline) for index in range(count)]
    finally:
        pipeline.close()
    for name in found[0]:
        unit = "ms" if name.endswith("packed in") else "kB"
        part.add(f"kitchen with a vase: {name}", float(np.mean([each[name] for each in found])), unit)
    for name in ("layer", "composite as JPEG"):
        bytes_ = float(np.mean([each[name] for each in found])) * 1e3
        part.add(f"kitchen with a vase: {name}, at {FPS} frames/s", bytes_ * 8e-6 * FPS, "Mbit/s")
    return part


def _sizes(source: Source, index: int, pipeline: ClientSession) -> dict[str, float]:
    frame = source[index]
    result = pipeline.process(frame, watched=True)
    sent = Frame(
        frame=index,
        timestamp_s=frame.timestamp_s,
        world_from_camera=None,
        color=encode_color(frame.color),
        depth=encode_depth(frame.depth, "zdelta"),  # as browsers do: they get theirs so too
    )
    return _layer_sizes(sent, result) | _composite_sizes(result)


def _layer_sizes(sent: Frame, result: FrameResult) -> dict[str, float]:
    began_s = time.perf_counter()
    layer = layer_message(sent, result, result.plan)
    data = encode(layer)
    took_ms = 1e3 * (time.perf_counter() - began_s)
    parts = {"virtual": layer.virtual, "ratio": layer.ratio}
    found = {"layer": len(data) / 1e3, "layer packed in": took_ms}
    for name, patch in parts.items():
        found[f"layer, {name}: colour"] = 0.0 if patch is None else len(patch.color.data) / 1e3
        found[f"layer, {name}: depth"] = 0.0 if patch is None else len(patch.depth.data) / 1e3
    return found


def _composite_sizes(result: FrameResult) -> dict[str, float]:
    assert result.color is not None
    began_s = time.perf_counter()
    picture = encode_color(result.color, "jpeg", quality=JPEG_QUALITY)
    took_ms = 1e3 * (time.perf_counter() - began_s)
    return {"composite as JPEG": len(picture.data) / 1e3, "composite packed in": took_ms}


def layer_screen_part(run: Run, _out: Path) -> Part:
    """A ball on the table, 30 degrees/s, GR15FAST, 300 ms away. Raises UnmeasurableError where there is no Chromium."""
    with chromium() as browser:
        from tests.client.web.displayed import Displayed, display
        from tests.client.web.layer_figures import errors_of
        from tests.client.web.layer_session import Seen, begin, foot_of, place_ball, show_ball, watched_server
        from tests.client.web.red_ball import TurningTable, is_red, silhouette

        count = run.of(QUICK_DISPLAYED, DISPLAYED)
        source = TurningTable(SIZE, REACH_DEG, STEP_DEG)
        frames, seen = [source[i] for i in range(len(source))], Seen()
        with watched_server(run.device, seen) as server, impaired(server.url, DELAY_S) as link:
            page = _open(browser, link.url, source.camera, frames)
            begin(page)
            place_ball(page, source, seen)
            show_ball(page, source)
            page.wait_for_timeout(SETTLING_MS)
            shown: list[Displayed] = []
            while len(shown) < count:
                shown += display(page, min(BATCH, count - len(shown)))
                run.say(f"layers on the screen: {len(shown)} of {count} display frames")
            age_ms = float(page.locator("#age-layer-median").text_content() or "nan")
            page.context.close()
        errors = errors_of(
            shown,
            source.camera,
            is_red,
            lambda frame: silhouette(source.camera, frame, foot_of(seen)),
            frames,
            seen.frames,
        )
        part = Part(sizes={"display frames of layer mode": count})
        _add_ages(part, shown, age_ms)
        for column, name in enumerate(("place", "outline")):
            moved, still = errors.moved_px[:, column].mean(), errors.still_px[:, column].mean()
            part.add(f"layer mode: error of the ball's {name}, mean", float(moved), "pixels")
            part.add(f"layer mode: the same if it were not moved to the newest pose: {name}", float(still), "pixels")
            part.add(f"layer mode: share of it that is left: {name}", float(errors.shares[column]), "", "<= 0.25")
        return part


def _open(browser: Any, url: str, camera: Any, frames: Any) -> Any:
    from tests.client.web.sequence import of_device

    page = browser.new_context(viewport={"width": 600, "height": 800}, has_touch=True).new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.add_init_script(path=WEB / "device.js")
    page.goto(url)
    page.evaluate("given => device.load(given)", of_device(camera, frames) | {"fps": 1e-6})
    return page


def _add_ages(part: Part, shown: Any, layer_age_ms: float) -> None:
    """In the order of the batches, between which time goes by unseen."""
    ages = [each.picture_age for each in shown]
    steps_ms = [b.time_ms - a.time_ms for a, b in pairwise(shown) if b.count == a.count + 1]
    part.add("layer mode: age of the camera's picture on the screen, largest", max(ages), "display frames", "<= 2")
    part.add("layer mode: the same, p99", float(np.percentile(ages, 99)), "display frames", "<= 2")
    part.add("layer mode: age of the objects on the screen, median", layer_age_ms, "ms")
    part.add("layer mode: the display", 1e3 / float(np.mean(steps_ms)), "frames/s")
    layers = len({each.layer_frame for each in shown})
    part.add("layer mode: display frames for each layer", len(shown) / layers, "")
