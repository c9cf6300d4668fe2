"""What `stream` shows while it runs: statistics, words, the picture in half blocks."""

from __future__ import annotations

import io

import msgspec
import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress

from client.display.stream_statistics import StreamStatistics
from client.display.stream_view import StreamView, coding_line, half_blocks, light_line
from client.streaming.coding import Coding
from tests.protocol.samples import SERVER

LIGHT, COMPOSITE = SERVER["light"], SERVER["composite"]


def test_a_frames_way_is_taken_apart() -> None:
    statistics = StreamStatistics()
    assert statistics.percentiles("way") is None
    statistics.note_sent(7, captured_s=10.0, sent_s=10.005, size_bytes=1000)
    statistics.note_answer(7, returned_s=10.105, shown_s=10.115, computed_s=0.06, size_bytes=500, waited_s=0.01)
    found = {stage: statistics.percentiles(stage)[0] for stage in statistics.milliseconds}
    assert found == pytest.approx({"encode": 5, "way": 30, "wait": 10, "compute": 60, "show": 10, "whole": 115})


def test_percentiles_are_of_many_frames_and_dropped_ones_do_not_count() -> None:
    statistics = StreamStatistics()
    for number in range(100):
        statistics.note_sent(number, number, number, 1)
        if number % 10:
            statistics.note_answer(number, number + 0.001 * number, number + 0.001 * number, 0.0, 1)
        else:
            statistics.forget(number)
            statistics.note_answer(number, number + 50.0, number + 50.0, 0.0, 1)
    p50, p99 = statistics.percentiles("whole")
    assert p50 == pytest.approx(50, abs=2)
    assert 95 < p99 <= 99


def test_rates_are_of_the_last_seconds() -> None:
    statistics = StreamStatistics()
    for number in range(100):
        statistics.note_sent(number, number / 10, number / 10, 12_500)
    sent, up, answered, down = statistics.rates(10.0)
    assert (sent, up) == pytest.approx((10, 1), rel=0.05)
    assert (answered, down) == (0, 0)
    assert statistics.rates(100.0) == (0, 0, 0, 0)


def test_half_blocks_have_the_pictures_colours() -> None:
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[:20] = 255, 0, 0
    picture[20:] = 0, 0, 255
    text = half_blocks(picture, 30)
    lines = text.plain.split("\n")
    assert {len(line) for line in lines} == {30}
    assert len(lines) == 10
    styles = [str(span.style) for span in text.spans]
    assert styles[0] == "#ff0000 on #ff0000"
    assert styles[-1] == "#0000ff on #0000ff"


def shown(is_terminal: bool, with_picture: bool = True) -> str:
    file = io.StringIO()
    console = Console(file=file, force_terminal=is_terminal, width=100, height=60, color_system="truecolor")
    statistics = StreamStatistics()
    statistics.note_sent(COMPOSITE.frame, 1.0, 1.01, 90_000)
    statistics.note_answer(COMPOSITE.frame, 1.2, 1.21, 0.1, 40_000)
    with StreamView(console, Progress(console=console), statistics, with_picture) as view:
        picture = np.full((40, 60, 3), 9, np.uint8)
        view.show(1.3, LIGHT, COMPOSITE, picture, Coding(65, 2, depth_noise_per_m=0.003), reconnected=2)
        assert view.wants_pictures is (is_terminal and with_picture)
        if is_terminal:
            console.print(view.render())
    return file.getvalue()


def test_the_terminal_shows_rates_stages_light_plan_and_reconnects() -> None:
    text = shown(True)
    for words in (
        "there and back",
        "waited at the server",
        "p50 90 ms",
        "intensity",
        "composite",
        "quality 65 at 1/2",
        "restored 2 times",
    ):
        assert words in text
    assert "▀" in text
    assert "▀" not in shown(True, with_picture=False)


def test_where_there_is_no_terminal_nothing_is_drawn() -> None:
    assert shown(False) == ""


def test_words_for_light_and_coding() -> None:
    unsure = msgspec.structs.replace(LIGHT, valid=False, lamps=(), dominant_direction=(0.0, 1.0, 0.0))
    assert light_line(unsure).startswith("from (+0.00, +1.00, +0.00), intensity")
    assert light_line(unsure).endswith("not fixed by the pictures so far")
    assert coding_line(Coding()) == "JPEG of quality 90, exact depth"
    assert coding_line(Coding(75), "H.264") == "H.264 of quality 75, exact depth"
    assert coding_line(Coding(50, 2, 9, 0.0014)).endswith("depth to within 1.4 mm at 1 m")
