"""`probeless bench`: which suites there are, and what it says where something that they need is missing."""

from __future__ import annotations

import sys

import pytest

from client.cli import FAILURE_STATUS, run_command
from client.commands import bench
from client.commands.bench import SUITES, find_suite
from client.errors import OptionError
from server.opencl import device


@pytest.mark.parametrize("name", SUITES)
def test_every_suite_is_found(name: str) -> None:
    assert find_suite(name).__module__ == f"tests.bench.{name}.suite"


@pytest.mark.parametrize("name", ["report", "os", "light.suite"])
def test_only_suites_are_found(name: str) -> None:
    with pytest.raises(OptionError, match="there are: geometry, light"):
        find_suite(name)


@pytest.mark.parametrize(
    ("suite", "package"), [("service", "schemathesis"), ("client", "httpx"), ("accuracy", "matplotlib")]
)
def test_a_missing_package_is_one_line_that_names_the_target(
    suite: str, package: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_device(_name: str | None) -> None:
        raise AssertionError("the suite has begun to measure")

    monkeypatch.setattr(device, "open_device", no_device)
    for module in [name for name in sys.modules if name.split(".")[0] in (package, "tests")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    assert run_command(["bench", suite]) == FAILURE_STATUS
    wanted = f"probeless: bench {suite} needs {package}, which is not installed: make install-bench installs it"
    assert capsys.readouterr().err.strip() == wanted


def test_without_a_checkout_it_says_where_the_suites_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "_exists", lambda _module: False)
    assert run_command(["bench", "light"]) == FAILURE_STATUS
    assert "source checkout" in capsys.readouterr().err


def test_a_missing_module_of_the_project_is_a_defect_and_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def suite(quick: bool, say: object) -> dict[str, object]:  # noqa: ARG001
        raise ModuleNotFoundError("No module named 'tests.gone'", name="tests.gone")

    monkeypatch.setattr(bench, "find_suite", lambda _name: suite)
    assert run_command(["bench", "light"]) == FAILURE_STATUS
    assert "internal error" in capsys.readouterr().err
