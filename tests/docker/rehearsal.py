"""A Dockerfile's steps in a clean Debian root, where there is no container engine; then the server in it, put to use.

    python -m tests.docker.rehearsal docker/cpu.Dockerfile FOLDER

As root, with debootstrap and the network. FOLDER becomes the root, and stays. What a container would do then is done by
unshare and chroot: the image's command is the first process of its namespace, as the image's user, in a root that is
read-only but for /data, /tmp and /dev/shm. It must become healthy by the image's own health check, answer the frames of
a client, be healthy again after its server was killed, leave no process unreaped, and end with status 0 when its first
process is told to. What is not tried is what only an engine has: layers, a network of its own, limits.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from tests.bench.service.process import children, descendants
from tests.docker.dockerfile import ROOT, Image, assigned, copies, read_image

MIRROR = "http://deb.debian.org/debian"
HEALTHY_WITHIN_S, STOPPED_WITHIN_S = 300.0, 90.0
TOKEN = "rehearsal"
FRAMES = 8


def main() -> int:
    """0 if all went well."""
    dockerfile, root = Path(sys.argv[1]), Path(sys.argv[2]).resolve()
    image = read_image(dockerfile)
    with mounted(root, image):
        build(image, root)
        use(image, root)
    return 0


def build(image: Image, root: Path) -> None:
    """Play the instructions up to the last RUN."""
    folder, environment = "/", build_environment(root)
    for name, rest in image.steps:
        say(f"{name} {rest}")
        match name:
            case "WORKDIR":
                folder = rest
                inside(root, folder).mkdir(parents=True, exist_ok=True)
            case "COPY":
                copy(root, folder, *copies(rest))
            case "ARG" | "ENV":
                environment |= assigned(rest)
            case "RUN":
                began = time.perf_counter()
                subprocess.run(
                    ["chroot", root, "env", "-i", *pairs(environment), "sh", "-c", f"cd {folder} && {rest}"], check=True
                )
                say(f"... {time.perf_counter() - began:.0f} s")


def use(image: Image, root: Path) -> None:
    """Start what the image starts, as its user; healthy, frames answered, started again, stopped in order."""
    given = {"PATH": "/usr/bin:/bin", "PROBELESS_TOKEN": TOKEN, "PROBELESS_PORT": str(free_port())}
    environment = given | image.environment
    port = int(environment["PROBELESS_PORT"])
    folder = image.last("WORKDIR")
    as_user = ["chroot", f"--userspec={image.last('USER')}", str(root), "env", "-i", *pairs(environment)]

    def command(words: list[str]) -> list[str]:
        return [*as_user, "sh", "-c", f'cd {folder} && exec "$@"', "sh", *words]

    def wait_until_healthy() -> None:
        began = time.perf_counter()
        while subprocess.run(command(image.health_command), check=False, capture_output=True).returncode != 0:
            if engine.poll() is not None or time.perf_counter() - began > HEALTHY_WITHIN_S:
                raise RuntimeError("the server did not become healthy")
            time.sleep(0.5)
        say(f"healthy after {time.perf_counter() - began:.1f} s")

    engine = subprocess.Popen(contained(root, command(image.command)), start_new_session=True)
    try:
        wait_until_healthy()
        (first,) = children(engine.pid)
        say(urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz").read().decode())
        say(f"its first process runs as {owner(first)}, may write: {writable(first)}")
        stream(port)
        (keeper,) = children(first)
        (server,) = children(keeper)
        os.kill(server, signal.SIGKILL)
        say("its server was killed")
        while children(keeper) in ([], [server]):
            time.sleep(0.1)
        wait_until_healthy()
        stream(port)
        while unreaped := [one for one in descendants(first) if state(one) == "Z"]:
            say(f"unreaped: {unreaped}")
            time.sleep(1.0)
        os.kill(first, signal.SIGTERM)
        began = time.perf_counter()
        status = engine.wait(STOPPED_WITHIN_S)
    finally:
        engine.kill()
    say(f"SIGTERM: exit status {status} after {time.perf_counter() - began:.1f} s")
    if status != 0:
        raise RuntimeError(f"the server ended with status {status}")


def contained(root: Path, command: list[str]) -> list[str]:
    """The command as the first process of its namespace, in a read-only root, without a way to more rights."""
    mounts = (
        f"mount --rbind {root} {root}",
        f"mount --bind {root}/data {root}/data",
        f"mount -t proc proc {root}/proc",
        f"mount -o remount,bind,ro {root}",
    )
    script = " && ".join((*mounts, 'exec setpriv --no-new-privs "$@"'))
    return ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", script, "sh", *command]


def state(pid: int) -> str:
    """Of a process, as in /proc; empty where there is none any more."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    return ""


def stream(port: int) -> None:
    """A client outside of the root sends frames of a synthetic scene into it. Raises RuntimeError."""
    source = ["synthetic:table", "--frames", f"0:{FRAMES}", "--lossless"]
    where = ["--server", f"http://127.0.0.1:{port}", "--token", TOKEN]
    out = subprocess.run(
        [Path(sys.executable).with_name("probeless"), "stream", *source, *where],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    answered = re.search(r"(\d+) frames answered", out.stdout + out.stderr)
    if out.returncode != 0 or answered is None or int(answered.group(1)) != FRAMES:
        raise RuntimeError(f"the client ended with {out.returncode}: {out.stdout}{out.stderr}")
    say(answered.string.strip())


@contextlib.contextmanager
def mounted(root: Path, image: Image) -> Iterator[None]:
    """A minimal root of the release that the image is made from, with what a container too finds in it."""
    if not (root / "bin/sh").exists():
        release = image.last("FROM").partition("@")[0].partition(":")[2].removesuffix("-slim")
        subprocess.run(["debootstrap", "--variant=minbase", release, root, MIRROR], check=True)
    for name in ("resolv.conf", "hosts"):
        shutil.copy(f"/etc/{name}", root / "etc" / name)
    with contextlib.ExitStack() as stack:
        for kind, where in (("proc", "proc"), ("sysfs", "sys")):
            subprocess.run(["mount", "-t", kind, kind, root / where], check=True)
            stack.callback(subprocess.run, ["umount", root / where], check=True)
        for where in ("tmp", "dev/shm"):
            (root / where).mkdir(exist_ok=True)
            subprocess.run(["mount", "-t", "tmpfs", "-o", "mode=1777", "tmpfs", root / where], check=True)
            stack.callback(subprocess.run, ["umount", root / where], check=True)
        yield


def build_environment(root: Path) -> dict[str, str]:
    """What this machine needs to reach the network goes along, as build arguments do."""
    environment = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root", "LANG": "C.UTF-8"}
    authorities = os.environ.get("PIP_CERT")
    if authorities is not None:
        shutil.copy(authorities, root / "etc/rehearsal-ca.pem")
        environment["PIP_CERT"] = "/etc/rehearsal-ca.pem"
    return environment | {name: value for name, value in os.environ.items() if name.lower().endswith("_proxy")}


def copy(root: Path, folder: str, sources: list[str], destination: str) -> None:
    """COPY: a folder's contents into `destination`, files under their own names where it ends in a slash."""
    to = inside(root, str(Path(folder) / destination))
    for source in (ROOT / name for name in sources):
        if source.is_dir():
            shutil.copytree(
                source, to, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__", "node_modules")
            )
        else:
            to.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, to / source.name)


def inside(root: Path, path: str) -> Path:
    """A path of the root, seen from here."""
    return root / path.lstrip("/")


def pairs(environment: dict[str, str]) -> list[str]:
    """As `env` takes them."""
    return [f"{name}={value}" for name, value in environment.items()]


def owner(pid: int) -> str:
    """User and group of a process."""
    found = Path(f"/proc/{pid}").stat()
    return f"{found.st_uid}:{found.st_gid}"


def writable(pid: int) -> str:
    """Folders of the process's working folder and root that it may write to."""
    found = Path(f"/proc/{pid}/root")
    user = found.parent.stat().st_uid
    words = ["nsenter", "--mount", f"--target={pid}", f"--setuid={user}", f"--setgid={user}", f"--root={found}"]
    look = ["find", "/", "/dev", "/opt/probeless", "-maxdepth", "1", "-type", "d", "-writable"]
    out = subprocess.run([*words, *look], check=False, capture_output=True, text=True)
    return " ".join(sorted(set(out.stdout.split()))) or "nothing"


def free_port() -> int:
    """One that nothing listens on."""
    with socket.create_server(("127.0.0.1", 0)) as found:
        return int(found.getsockname()[1])


def say(line: str) -> None:
    """Progress."""
    sys.stdout.write(f"rehearsal: {line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
