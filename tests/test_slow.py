"""The list of slow tests is of tests that there are, and is written as it says."""

import pytest

from tests.absent import NO_DATA, is_unexpected
from tests.slow import choose_slow, read_durations, read_list, stale_lines, without_device


def test_every_line_of_the_list_names_a_test(stale_slow_lines: list[str]) -> None:
    assert stale_slow_lines == [], "make slow-list"
    assert len(read_list()) > 100


def test_the_cheapest_calls_of_a_function_and_of_a_file_are_quick() -> None:
    took_s = {
        "tests/a.py::test_x[1]": 0.4,
        "tests/a.py::test_x[2]": 0.1,
        "tests/a.py::test_x[3]": 0.5,
        "tests/a.py::test_y[1]": 2.0,
        "tests/a.py::test_y[2]": 1.0,
        "tests/b.py::test_z": 2.5,
        "tests/b.py::test_w": 2.0,
        "tests/c.py::test_v": 9.0,
    }
    assert choose_slow(took_s) == {
        "tests/a.py::test_x[3]": 0.5,
        "tests/a.py::test_y": 3.0,
        "tests/b.py::test_z": 2.5,
        "tests/c.py::test_v": 9.0,
    }


def test_set_up_and_tear_down_count() -> None:
    lines = (
        "1.50s setup    tests/a.py::test_x[a b]",
        "0.25s call     tests/a.py::test_x[a b]",
        "FAILED tests/a.py::test_y",
    )
    assert read_durations("\n".join(lines)) == {"tests/a.py::test_x[a b]": 1.75}


@pytest.mark.parametrize(
    ("whole", "rest"),
    [
        ("[{}]", ""),
        ("[{}-size0-True]", "[size0-True]"),
        ("[size0-{}]", "[size0]"),
        ("[size0-{}-True]", "[size0-True]"),
    ],
)
def test_the_device_is_no_part_of_a_name(whole: str, rest: str) -> None:
    device = "Some / pthread-Device 9-V"
    assert without_device(f"tests/a.py::test_x{whole.format(device)}", device) == f"tests/a.py::test_x{rest}"


def test_lines_that_name_no_test_are_found() -> None:
    collected = ["tests/a.py::test_x[1]", "tests/a.py::test_y"]
    right = [
        "tests/a.py::test_x",
        "tests/a.py::test_x[1]",
        "tests/a.py::test_y",
        "tests/test_slow.py::of_no_test_found",
    ]
    wrong = ["tests/a.py::test_x[2]", "tests/a.py::test", "tests/gone.py::test_x"]
    assert stale_lines(right + wrong, collected) == wrong


def test_only_data_and_hardware_may_be_absent_where_all_is_expected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PROBELESS_EXPECT", raising=False)
    assert not is_unexpected("Skipped: there is no chromium")
    monkeypatch.setenv("PROBELESS_EXPECT", "all")
    assert is_unexpected("Skipped: there is no chromium")
    assert not is_unexpected(f"Skipped: {NO_DATA} x is not here")
