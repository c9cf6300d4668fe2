"""A recorded sequence as the page's source: what the Python client recorded is streamed from the browser, as it was."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page

from client.commands.stream import stream
from client.options.source import open_source
from client.sources.recording import open_recording
from protocol.frames import RgbdFrame
from protocol.messages import Wishes
from protocol.recording import read_messages
from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.constants import PATIENCE_MS
from tests.client.web.page import newer_pictures, on_screen, picture, start_recording
from tests.client.web.received import Received
from tests.client.web.visible_silhouette import may_be_seen
from tests.client.web.watched import SIZE, TOUCHED, point_under, wait_for
from tests.service.proxy import impaired

FRAMES = 8
SOURCE = f"synthetic:table?light=7&size=160x120&frames={FRAMES}"
COUNT = 8 * FRAMES


@pytest.fixture
def build_pipeline(received: Received) -> Callable[..., object]:
    """Pipelines that keep what they were given."""
    return received.build


@pytest.fixture
def recording(server: BackgroundServer, received: Received, tmp_path: Path) -> Path:
    """Of eight frames, by the Python client."""
    path = tmp_path / "table.rec"
    source = open_source(SOURCE)
    wishes = Wishes(poses="given", up=source.up, voxel_m=0.01)
    others = {"record": path, "realtime": False}
    with ThreadPoolExecutor() as aside:  # Playwright's own loop runs in this thread
        aside.submit(stream, source, server.url, (), wishes, **others).result()
    assert len(open_recording(path)) == FRAMES
    for kept in (received.hellos, received.cameras, received.wishes, received.frames):
        kept.clear()
    return path


def same_pixels(a: RgbdFrame, b: RgbdFrame) -> bool:
    return np.array_equal(a.color, b.color) and np.array_equal(a.depth, b.depth)


def test_frames_arrive_bit_for_bit_at_their_own_pace_again_and_again(
    server: BackgroundServer, received: Received, recording: Path, open_page: OpenPage
) -> None:
    page = open_page(server.url)
    start_recording(page, recording)
    received.wait(1)
    begun_s = time.monotonic()
    got = received.wait(COUNT)[:COUNT]
    took_s = time.monotonic() - begun_s
    wait_for_text(page, "#state", "Live, captured here")
    recorded = list(open_recording(recording))
    assert received.cameras == [open_recording(recording).camera]
    wishes = received.wishes[0]
    assert (wishes.poses, wishes.up, wishes.voxel_m, wishes.answer) == ("given", (0.0, 1.0, 0.0), 0.01, "picture")
    order = []
    for frame in got:
        which = [i for i, each in enumerate(recorded) if same_pixels(frame, each)]
        assert len(which) == 1
        assert np.array_equal(frame.world_from_camera, recorded[which[0]].world_from_camera)
        order.append(which[0])
    assert order[0] == 0
    assert sorted(set(order)) == list(range(FRAMES))
    steps = np.diff(order) % FRAMES
    times = np.array([frame.timestamp_s for frame in got])
    assert times[-1] - times[0] < took_s + 0.3  # never faster than recorded; what a busy machine misses is left out
    period_s = recorded[1].timestamp_s - recorded[0].timestamp_s
    ticks = np.diff(times) / period_s
    np.testing.assert_allclose(ticks, ticks.round(), atol=1e-3)
    assert ((ticks.round() - steps) % FRAMES == 0).all()  # whole rounds too may be left out


def test_at_its_end_the_last_picture_stands(
    server: BackgroundServer, received: Received, recording: Path, open_page: OpenPage
) -> None:
    page = open_page(server.url)
    start_recording(page, recording, "once")
    received.wait(FRAMES + 4)
    last = open_recording(recording)[FRAMES - 1]
    until_s = time.monotonic() + PATIENCE_MS / 1e3
    while not all(same_pixels(frame, last) for frame in received.frames[-3:]):
        assert time.monotonic() < until_s
        time.sleep(0.05)
    times = [frame.timestamp_s for frame in received.frames]
    assert (np.diff(times) > 0).all()
    wait_for_text(page, "#notes", "The recording has come to its end: its last picture stands.")


def test_a_file_that_is_none_and_one_that_was_cut_off_are_told(
    server: BackgroundServer, received: Received, recording: Path, open_page: OpenPage, tmp_path: Path
) -> None:
    page = open_page(f"{server.url}/?answer=light")
    page.locator("input[name=source][value=recorded]").check()
    assert page.locator("[name=answer]").input_value() == "picture"  # light is for what WebXR shows
    page.locator("#start").click()
    wait_for_text(
        page, "#capture-said", "Choose the recording: a file that probeless stream SOURCE --record FILE has made."
    )
    text = tmp_path / "letter.txt"
    text.write_text("Dear reader")
    start_recording(page, text)
    wait_for_text(page, "#capture-said", "letter.txt is no recording (byte 0: not a message of this version)")
    (tmp_path / "empty.rec").touch()
    start_recording(page, tmp_path / "empty.rec")
    wait_for_text(page, "#capture-said", "empty.rec holds no frames: choose a file that")
    cut = tmp_path / "cut.rec"
    cut.write_bytes(recording.read_bytes()[:-100])
    assert any(True for _ in read_messages(cut, lambda _: None))
    start_recording(page, cut)
    wait_for_text(page, "#state", "Live, captured here")
    wait_for_text(page, "#notes", "cut.rec was cut off inside a message")
    received.wait(FRAMES)


def test_a_large_file_is_never_in_memory_as_a_whole(
    server: BackgroundServer, received: Received, recording: Path, open_page: OpenPage, tmp_path: Path
) -> None:
    large = tmp_path / "large.rec"
    data = recording.read_bytes()
    with large.open("wb") as file:
        while file.tell() < 400 << 20:
            file.write(data)
    page = open_page(server.url)
    reads = "() => { const all = []; const own = Blob.prototype.slice; window.reads = all;"
    reads += " Blob.prototype.slice = function (a, b) { all.push(b - a); return own.call(this, a, b); }; }"
    page.evaluate(reads)
    start_recording(page, large)
    received.wait(2 * FRAMES)
    sizes = page.evaluate("() => window.reads")
    assert max(sizes) < 4 << 20
    assert sum(sizes) < 64 << 20  # as far as it was played


def test_the_real_server_renders_into_it_objects_are_placed_by_touch_and_a_cut_is_mended(
    real_server: BackgroundServer,
    asked: list,
    recording: Path,
    open_page: OpenPage,
    keep_picture: Callable[[Page, str], None],
) -> None:
    source = open_recording(recording)
    last = source[FRAMES - 1]
    with impaired(real_server.url) as proxy, closing(open_page(proxy.url, size=SIZE)) as page:
        start_recording(page, recording, "once")
        wait_for_text(page, "#state", "Live, captured here")
        wait_for_text(page, "#notes", "its last picture stands")
        newer_pictures(page)
        before = picture(page)
        page.locator("#place").click()
        page.locator("#picture").scroll_into_view_if_needed()
        page.touchscreen.tap(*on_screen(page, *TOUCHED))
        kind, placed = wait_for(asked, 1)
        assert kind == "place"
        assert np.abs(np.array(placed.position_m) - point_under(source.camera, last, *TOUCHED)).max() < 0.01
        newer_pictures(page)
        keep_picture(page, "recorded_placed")
        after = picture(page)
        vase = may_be_seen(source.camera, last, np.array(placed.position_m))
        assert np.abs(after - before)[vase].mean() > 15
        darker = (before - after)[~vase]
        assert (darker > 6).sum() > 80  # its shadow, on the table
        assert (darker < -6).sum() < 0.2 * (darker > 6).sum()

        proxy.refuses = True
        proxy.cut()
        wait_for_text(page, "#state", "Disconnected")
        keep_picture(page, "recorded_cut")
        proxy.refuses = False
        wait_for_text(page, "#state", "Live, captured here")
        newer_pictures(page)
        assert np.abs(picture(page) - after).mean() < 2  # the same session: the vase is there
        assert len(asked) == 1
        page.locator("#stop").click()
        wait_for_text(page, "#state", "waiting for a session")
