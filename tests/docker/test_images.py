"""What of the images can be checked without an engine: files, scripts and manifests fit each other and the program."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread

import pytest
import yaml

from server.cluster.settings import read_settings
from server.service.limits import DEFAULT_LIMITS
from server.service.serve import STOP_PATIENCE_S
from tests.docker.dockerfile import ROOT, Image, copies, install_steps, read_image

IMAGES = {name: read_image(ROOT / f"docker/{name}.Dockerfile") for name in ("cpu", "gpu", "cluster")}
SCRIPTS = sorted((ROOT / "docker").rglob("*.sh"))
COMPOSE = yaml.safe_load((ROOT / "docker/compose.yaml").read_text())
RAY_SERVICE = yaml.safe_load((ROOT / "docker/cluster/rayservice.yaml").read_text())
each_image = pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)


def copied(image: Image) -> set[str]:
    """Everything that an image is made from, as paths of the project."""
    return {source for name, rest in image.steps if name == "COPY" for source in copies(rest)[0]}


@each_image
def test_steps_are_those_of_the_script_in_an_order_that_works(image) -> None:
    steps = install_steps(image)
    assert steps[0] == "system"
    assert steps[-2:] == ["packages", "program"]
    assert not {"driver", "kuberay"} - set(install_steps(IMAGES["cluster"]))
    script = (ROOT / "docker/install.sh").read_text()
    assert all(re.search(rf"^{step}\(\) \{{", script, re.MULTILINE) for step in steps)


@each_image
def test_everything_that_a_step_reads_is_there_before_it(image) -> None:
    there: set[str] = set()
    for name, rest in image.steps:
        if name == "COPY":
            there |= {f"{copies(rest)[1]}install.sh"} if "install.sh" in rest else set(copies(rest)[0])
        lock = re.search(r"packages (\S+)", rest)
        if name == "RUN" and lock:
            assert lock.group(1) in there
        if name == "RUN" and rest.endswith("program"):
            assert {"Makefile", "pyproject.toml", "requirements.lock", "README.md", "docker"} <= there
    assert "docker/install.sh" in there


@each_image
def test_what_is_copied_exists_and_is_the_whole_program(image) -> None:
    assert all((ROOT / path).exists() for path in copied(image))
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]["find"]["include"]
    assert {name.rstrip("*") for name in packages} <= copied(image)
    ignored = (ROOT / ".dockerignore").read_text().split()
    assert not copied(image) & set(ignored)


@each_image
def test_its_base_is_pinned_and_that_of_the_others(image) -> None:
    assert re.fullmatch(r"debian:bookworm-slim@sha256:[0-9a-f]{64}", image.last("FROM"))
    assert image.last("FROM") == IMAGES["cpu"].last("FROM")


@each_image
def test_it_runs_without_rights_and_is_stopped_in_order(image) -> None:
    user = re.search(r"^USER_ID=(\d+)$", (ROOT / "docker/install.sh").read_text(), re.MULTILINE)
    assert user
    assert image.last("USER") == f"{user.group(1)}:{user.group(1)}"
    names = [name for name, _ in image.steps]
    assert names.index("USER") > max(index for index, name in enumerate(names) if name in ("RUN", "COPY"))
    assert image.last("STOPSIGNAL") == "SIGTERM"
    assert image.command[:2] == ["/usr/bin/tini", "--"]
    assert image.last("VOLUME") == image.environment["HOME"] == "/data"
    assert (ROOT / image.command[-1]).exists()
    assert image.last("WORKDIR") == "/opt/probeless"
    assert image.health_command == ["/opt/probeless/.venv/bin/python", "docker/health.py"]


def test_gpu_image_is_the_cpu_image_and_a_driver() -> None:
    own = ("ARG", "ENV")
    gpu = [step for step in IMAGES["gpu"].steps if step[0] not in own and "driver" not in step[1]]
    assert gpu == [step for step in IMAGES["cpu"].steps if step[0] not in own]
    assert IMAGES["gpu"].environment["NVIDIA_DRIVER_CAPABILITIES"] == "compute,utility"


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_scripts_are_right(script: Path) -> None:
    subprocess.run(["sh", "-n", script], check=True)
    if shutil.which("shellcheck"):
        subprocess.run(["shellcheck", script], check=True)


@pytest.mark.parametrize("words", [[], ["everything"], ["driver"], ["driver", "voodoo"], ["packages"]])
def test_wrong_step_is_refused_and_named(words) -> None:
    done = subprocess.run(["sh", ROOT / "docker/install.sh", *words], check=False, capture_output=True, text=True)
    assert done.returncode != 0
    assert (words or ["choose"])[-1] in done.stderr


def test_start_script_puts_the_server_in_its_place(tmp_path: Path) -> None:
    (tmp_path / "docker").mkdir()
    shutil.copy(ROOT / "docker/start.sh", tmp_path / "docker")
    program = tmp_path / ".venv/bin/probeless"
    program.parent.mkdir(parents=True)
    program.write_text('#!/bin/sh\necho "$$ $*"\necho an event >&2\n')
    program.chmod(0o755)
    started = subprocess.Popen(
        ["sh", tmp_path / "docker/start.sh", "--sessions", "3"],
        stdout=subprocess.PIPE,
        env={"PATH": os.environ["PATH"]},
    )
    said, _ = started.communicate()
    assert said.decode() == f"{started.pid} serve --host 0.0.0.0 --port 8080 --log json --sessions 3\nan event\n"


@pytest.mark.parametrize(("status", "expected"), [(200, 0), (503, 1), (None, 1)])
def test_health_check_says_what_the_server_says(status, expected) -> None:
    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status if self.path == "/healthz" else 404)
            self.end_headers()
            self.wfile.write(b'{"ready": "perhaps"}')

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Answer) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        port = server.server_port
        if status is None:
            server.shutdown()
            server.server_close()
        done = subprocess.run(
            [sys.executable, ROOT / "docker/health.py"],
            env=os.environ | {"PROBELESS_PORT": str(port)},
            check=False,
            capture_output=True,
            text=True,
        )
        server.shutdown()
    assert done.returncode == expected
    assert ("no answer" if status is None else "perhaps") in done.stdout


@pytest.mark.parametrize("name", ["cpu", "gpu"])
def test_compose_runs_the_images_with_nothing_they_do_not_need(name) -> None:
    service = COMPOSE["services"][name]
    image = IMAGES[name]
    assert service["profiles"] == [name]
    assert (ROOT / "docker" / service["build"]["context"] / service["build"]["dockerfile"]).resolve() == (
        ROOT / f"docker/{name}.Dockerfile"
    )
    volume, _, where = service["volumes"][0].partition(":")
    assert volume in COMPOSE["volumes"]
    assert where == image.last("VOLUME")
    assert service["environment"] == {"PROBELESS_TOKEN_FILE": f"/run/secrets/{service['secrets'][0]}"}
    assert COMPOSE["secrets"][service["secrets"][0]]["file"].startswith("${PROBELESS_TOKEN_PATH:?")
    assert service["mem_limit"] == service["memswap_limit"]
    assert service["ulimits"]["nofile"]["soft"] >= 4 * DEFAULT_LIMITS.connections_per_address
    assert service["ulimits"]["core"] == 0
    assert service["read_only"]
    assert service["cap_drop"] == ["ALL"]
    assert service["ports"][0].endswith(":" + image.last("EXPOSE"))
    assert float(service["stop_grace_period"].rstrip("s")) > STOP_PATIENCE_S
    known = {"build", "cap_drop", "deploy", "environment", "image", "pids_limit", "ports", "profiles", "read_only"}
    known |= {"restart", "security_opt", "stop_grace_period", "tmpfs", "volumes"}
    assert set(service) <= known | {"mem_limit", "memswap_limit", "secrets", "ulimits"}


def test_ray_service_says_what_the_application_understands() -> None:
    served = yaml.safe_load(RAY_SERVICE["spec"]["serveConfigV2"])
    application = served["applications"][0]
    settings = read_settings(application["args"])
    worker = RAY_SERVICE["spec"]["rayClusterConfig"]["workerGroupSpecs"][0]
    container = worker["template"]["spec"]["containers"][0]
    places = json.loads(json.loads(worker["rayStartParams"]["resources"]))["room"]
    assert settings.data == container["volumeMounts"][0]["mountPath"]
    assert settings.place["GPU"] * places <= float(container["resources"]["limits"]["nvidia.com/gpu"])
    assert settings.place["CPU"] * places <= float(container["resources"]["limits"]["cpu"])
    assert settings.policy.most <= places * worker["maxReplicas"]
    module, _, function = application["import_path"].partition(":")
    assert f"def {function}(" in (ROOT / (module.replace(".", "/") + ".py")).read_text()


def test_ray_service_runs_the_image_that_is_locked_to_its_ray() -> None:
    cluster = RAY_SERVICE["spec"]["rayClusterConfig"]
    locked = re.search(r"^ray==(\S+)", (ROOT / "requirements-cluster.lock").read_text(), re.MULTILINE)
    assert locked
    assert cluster["rayVersion"] == locked.group(1)
    for spec in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        pod = spec["template"]["spec"]
        user, _, group = IMAGES["cluster"].last("USER").partition(":")
        assert (pod["securityContext"]["runAsUser"], pod["securityContext"]["runAsGroup"]) == (int(user), int(group))
        assert pod["containers"][0]["image"] == "probeless:cluster"
        assert pod["containers"][0]["env"][0]["name"] == "PROBELESS_TOKEN"
    claim = yaml.safe_load((ROOT / "docker/cluster/rooms-claim.yaml").read_text())
    volume = cluster["workerGroupSpecs"][0]["template"]["spec"]["volumes"][0]
    assert volume["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]


def test_local_cluster_runs_what_the_application_understands() -> None:
    served = yaml.safe_load((ROOT / "docker/cluster/local.yaml").read_text())
    assert read_settings(served["applications"][0]["args"]).place["room"] == 1
    assert str(served["http_options"]["port"]) == IMAGES["cluster"].environment["PROBELESS_PORT"]
    assert "docker/cluster/local.yaml" in (ROOT / "docker/cluster/local.sh").read_text()


def test_line_that_is_not_understood_is_named(tmp_path: Path) -> None:
    path = tmp_path / "Dockerfile"
    path.write_text("FROM debian\n\nADD everything /\n")
    with pytest.raises(ValueError, match="line 3"):
        read_image(path)
