"""Command line. An error of the user ends with one line on standard error: status 2 for usage, 1 otherwise."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from client.display.light_words import light_lines
from client.errors import OWN_PACKAGES, OptionError, RunError
from client.options import capture_options as o
from client.options.capture import prepare, refuse_color, refuse_depth_noise
from client.options.capture_options import CaptureOptions, capturing
from client.options.help import ALL, GroupedHelp
from client.options.light_places import parse_panorama_out, write_panorama
from client.progress import Stopwatch, note, progress_bar, say, track
from client.results.extras import check_extras
from client.results.names import PAGE_NAME, PLACE_NAME
from protocol.messages import Light

RUN_EXAMPLES = """\
probeless run synthetic:table --out out/table
probeless run FOLDER --object Duck.glb@auto --out out/duck
probeless run FOLDER --object Duck.glb@table,0.3m --frames 0:60 --video --out out/duck
probeless run FOLDER --budget-ms 150 --out out/fast"""
STREAM_EXAMPLES = """\
probeless stream FOLDER --server URL --object Duck.glb@auto --out out/duck
probeless stream oak --server URL --view
probeless stream FOLDER --server URL --realtime --view
probeless stream FOLDER --server URL --room office --poses track"""
PLACE_EXAMPLES = """\
probeless place FOLDER
probeless place FOLDER --object Duck.glb --frames 0:60 --out out/place"""
EXPLAIN_EXAMPLES = """\
probeless explain FOLDER --object Duck.glb@auto
probeless explain synthetic:room --preset art4 --frame 10"""
SERVE_EXAMPLES = """\
probeless serve
probeless serve --host 0.0.0.0 --tls --objects models
probeless serve --device nvidia --data /var/lib/probeless"""
PACKAGES_OF_THE_SERVER = frozenset(
    {"pyopencl", "scipy", "trimesh", "fastapi", "starlette", "uvicorn", "prometheus_client", "cryptography"}
)
"""Dependencies that are not of the group `client` in pyproject.toml."""
USAGE_STATUS, FAILURE_STATUS, INTERRUPTED_STATUS = 2, 1, 130

app = typer.Typer(
    add_completion=False,
    no_args_is_help=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Lights virtual objects with the room's own light, with no light probe.",
)


def main() -> None:
    """Entry point: run the command; every error is one line."""
    arguments = _renamed([word for word in sys.argv[1:] if word != "--debug"])
    sys.exit(run_command(arguments, debug="--debug" in sys.argv[1:]))


def _renamed(arguments: list[str]) -> list[str]:
    """The arguments with `--video h264` as `--color h264`, its name since `--video` writes a file."""
    joined = "\0".join(arguments).replace("--video\0h264", "--color\0h264").replace("--video=h264", "--color=h264")
    return joined.split("\0") if arguments else []


def run_command(arguments: list[str], debug: bool = False) -> int:
    """The exit status of a command line."""
    state = {ALL: ALL in arguments}
    words = ["--help" if word == ALL else word for word in arguments]
    try:
        return typer.main.get_command(app).main(words, prog_name="probeless", standalone_mode=False, obj=state) or 0
    except KeyboardInterrupt:
        return INTERRUPTED_STATUS
    except BrokenPipeError:
        # The reader of stdout is gone; flushing at exit must not fail.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILURE_STATUS
    except Exception as error:
        if debug:
            traceback.print_exc()
        note(_one_line(error))
        return USAGE_STATUS if isinstance(error, OptionError | typer.TyperException) else FAILURE_STATUS


def _one_line(error: Exception) -> str:
    if isinstance(error, typer.TyperException):
        text = f"{error.format_message()} (probeless --help lists what there is)"
    elif type(error).__module__.split(".")[0] in OWN_PACKAGES:
        text = str(error)
    elif isinstance(error, ModuleNotFoundError) and str(error.name).split(".")[0] in PACKAGES_OF_THE_SERVER:
        text = f"this needs {error.name}, which an installation of the client alone leaves out: make install"
    else:
        text = f"internal error, {type(error).__name__}: {error} (run again with --debug to see where)"
    return " ".join(text.split())


@app.callback()
def common(
    debug: Annotated[
        bool, typer.Option("--debug", help="show the traceback of an error; valid at any position")
    ] = False,
) -> None:
    """Lights virtual objects with the room's own light, with no light probe."""


@app.command(cls=GroupedHelp, epilog=RUN_EXAMPLES)
@capturing
def run(
    options: CaptureOptions,
    out: Annotated[Path, typer.Option(metavar="DIR", help="output folder")],
    overwrite: o.Overwrite = False,
    video: o.VideoFileOption = False,
    rerun: o.RerunOption = None,
    mesh: o.Mesh = False,
    scene: o.Scene = False,
    panorama_out: o.PanoramaFile = None,
    device: o.DeviceOption = None,
) -> None:
    """Run the pipeline in one process, without a network."""
    panorama = parse_panorama_out(panorama_out)
    check_extras(video, rerun)
    capture = prepare(options)
    from client.commands.run import Run
    from client.results.description import describe
    from client.results.output_folder import OutputWriter

    if mesh or scene:
        from server.meshing.surface import find_library

        find_library()  # a missing library is an error before the frames, not after
    watch, light = Stopwatch(), None
    description = describe(capture.source, capture.total, capture.objects)
    writing = OutputWriter(out, description, overwrite=overwrite, video=video, rerun=rerun)
    with _telling_of_interrupts(out), writing as writer, Run(capture, device, note) as pipeline:
        writer.note_device(pipeline.device)
        for output in track(pipeline.outputs(), capture.total):
            writer.write(output)
            watch.frames += 1
            light = output.light
        if mesh:
            with progress_bar("mesh") as progress:
                writer.write_mesh(pipeline.mesh(progress))
        if scene:
            with progress_bar("scene") as progress:
                writer.write_scene(pipeline.scene(progress))
        if panorama is not None:
            write_panorama(panorama.path, pipeline.panorama(panorama.format, panorama.position_m))
    say(f"{watch.summary()}{_written_to(out)}")
    _say_light(light)


@app.command(epilog=PLACE_EXAMPLES, cls=GroupedHelp)
def place(
    source: o.SourceArgument,
    object: Annotated[str, typer.Option(metavar="FILE", help="model, for the command that the page shows")] = "FILE",
    frames: o.Frames = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="output folder")] = Path("out/place"),
    open_page: Annotated[bool, typer.Option("--open", help="open the page in the browser of this machine")] = False,
) -> None:
    """Write a page in which a click on a surface says where an object is to stand."""
    from client.commands.place import frames_to_show, write_place_page
    from client.options.capture import parse_frames
    from client.options.source import open_source

    opened = open_source(source)
    page = out / PLACE_NAME
    write_place_page(page, opened, source, frames_to_show(parse_frames(frames, len(opened))), object)
    say(f"open {page} in a browser and click a surface")
    if open_page:
        typer.launch(str(page.resolve()))


@app.command(cls=GroupedHelp, epilog=EXPLAIN_EXAMPLES)
@capturing
def explain(
    options: CaptureOptions,
    frame: Annotated[
        int | None, typer.Option(metavar="N", help="position in the source; default: the fifth frame")
    ] = None,
    device: o.DeviceOption = None,
) -> None:
    """Explain the plan of a frame: which effects run, which are left out, and why."""
    capture = prepare(options)
    from client.commands.explain import explain as explain_frame

    for line in explain_frame(capture, frame, device):
        say(line)


@app.command(cls=GroupedHelp, epilog=STREAM_EXAMPLES)
@capturing
def stream(
    options: CaptureOptions,
    server: Annotated[
        str, typer.Option(metavar="URL", help="as the server prints it: http://localhost:8080/?token=...")
    ],
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="output folder")] = None,
    overwrite: o.Overwrite = False,
    video: o.VideoFileOption = False,
    rerun: o.RerunOption = None,
    record: Annotated[Path | None, typer.Option(metavar="FILE", help="write all messages into a recording")] = None,
    lossless: Annotated[
        bool, typer.Option("--lossless", help="raw colour and exact depth; wait for every answer")
    ] = False,
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime",
            help="as a camera: skip frames while the server is busy; default: all frames of a folder are answered",
        ),
    ] = False,
    adapt: Annotated[
        bool, typer.Option(help="of a camera or with --realtime: adapt picture quality, size and rate to the link")
    ] = True,
    depth_noise: Annotated[
        float | None,
        typer.Option(metavar="M", help="noise of the sensor at 1 m; depth may be rounded by this times z^2"),
    ] = None,
    color: Annotated[
        str | None,
        typer.Option(
            metavar="jpeg|h264", help="how colour is sent; h264: as video, both sides need PyAV; default: jpeg"
        ),
    ] = None,
    answer: Annotated[
        str | None,
        typer.Option(metavar="picture|layer|light", help="layer: composed here; default: picture"),
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="show the picture in the terminal")] = False,
    mesh: o.Mesh = False,
    panorama_out: o.PanoramaFile = None,
    room: o.RoomName = None,
    room_key: o.RoomKey = None,
    room_from_world: o.RoomFromWorld = None,
    marker: o.MarkerOption = None,
    token: o.Token = None,
    tls_fingerprint: Annotated[
        str | None, typer.Option(metavar="SHA256", help="fingerprint of the server's certificate")
    ] = None,
    tls_ca: Annotated[
        Path | None, typer.Option(metavar="FILE", help="authority that signed its certificate, PEM")
    ] = None,
    device: o.DeviceOption = None,
) -> None:
    """Send a source to a server, show and write the answers."""
    if device is not None:
        raise OptionError("--device: the server has the device; name it there with probeless serve --device")
    if mesh and out is None:
        raise OptionError("--mesh writes files: say where with --out")
    if (video or rerun is not None) and out is None:
        raise OptionError("--video and --rerun go with --out DIR; name a folder")
    check_extras(video, rerun)
    refuse_depth_noise(depth_noise, lossless)
    refuse_color(color, lossless)
    panorama = parse_panorama_out(panorama_out)
    capture = prepare(options, lossless=lossless, answer=answer)
    from client.commands.stream import Sending
    from client.commands.stream import stream as send
    from client.options.room_options import room_place
    from client.sources.frame_source import is_live
    from client.streaming.client import Access

    with _telling_of_interrupts(out):
        done = send(
            capture.source,
            server,
            capture.objects,
            capture.wishes,
            out,
            lossless,
            record,
            realtime=realtime or is_live(capture.source),
            frames=capture.frames,
            mesh=mesh,
            panorama=panorama,
            room=room_place(room, room_from_world, marker, room_key),
            access=Access(token, tls_fingerprint, tls_ca),
            sending=Sending(adapt, depth_noise, view, color == "h264"),
            overwrite=overwrite,
            video=video,
            rerun=rerun,
        )
    speed = done.answered / done.seconds if done.seconds > 0 else 0.0
    say(
        f"{done.answered} frames answered in {done.seconds:.1f} s ({speed:.1f} frames/s), {done.skipped} skipped, "
        f"{done.dropped} dropped{_written_to(out)}"
    )
    _say_light(done.light)


@contextmanager
def _telling_of_interrupts(out: Path | None) -> Iterator[None]:
    """After Ctrl-C, a note that says where the page of what was made is."""
    try:
        yield
    except KeyboardInterrupt:
        if out is not None and (out / PAGE_NAME).is_file():
            note(f"interrupted; {out / PAGE_NAME} shows the frames until here")
        raise


def _written_to(out: Path | None) -> str:
    """Where results are, and what to open to see them."""
    if out is None:
        return ""
    page = out / PAGE_NAME
    return f", written to {out}: open {page} in a browser" if page.is_file() else f", written to {out}"


def _say_light(light: Light | None) -> None:
    """The last frame's light, and what is not known of it."""
    if light is not None:
        for line in light_lines(light):
            say(line)


@app.command(cls=GroupedHelp, epilog=SERVE_EXAMPLES)
def serve(
    host: Annotated[str, typer.Option(help="address to listen on; 0.0.0.0 for all")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free port")] = 8080,
    device: o.DeviceOption = None,
    token: o.ServeToken = None,
    token_file: o.TokenFile = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="with --token none: allow access from other machines")
    ] = False,
    allow_origin: o.AllowOrigin = None,
    trusted_proxy: Annotated[
        list[str] | None,
        typer.Option(metavar="ADDRESS[/BITS]", help="proxy whose X-Forwarded-For is believed; repeatable"),
    ] = None,
    tls: Annotated[
        bool,
        typer.Option("--tls", help="https and wss, with a certificate of its own, which a phone can be told to trust"),
    ] = False,
    tls_cert: Annotated[Path | None, typer.Option(metavar="FILE", help="own certificate, PEM")] = None,
    tls_key: Annotated[Path | None, typer.Option(metavar="FILE", help="key of the certificate, PEM")] = None,
    volume_memory: Annotated[int | None, typer.Option(metavar="MIB", help="memory of one volume; default 512")] = None,
    sessions: Annotated[int | None, typer.Option(min=1, help="concurrent capturing sessions; default 16")] = None,
    sessions_per_address: Annotated[
        int | None, typer.Option(min=1, help="concurrent sessions of one client; default 8")
    ] = None,
    objects: Annotated[Path | None, typer.Option(metavar="DIR", help="models that clients may place by name")] = None,
    data: Annotated[
        str | None, typer.Option(metavar="DIR|none", help="folder of saved rooms; default: the user's data folder")
    ] = None,
    data_gib: Annotated[
        float | None,
        typer.Option(min=0, help="limit of saved rooms, oldest removed first; default 16, 0: no limit"),
    ] = None,
    data_days: Annotated[
        float | None, typer.Option(min=0, help="unused saved rooms are removed after this; default 180, 0: never")
    ] = None,
    restart: Annotated[bool, typer.Option("--restart/--no-restart", help="start it again where it crashes")] = True,
    log: Annotated[str, typer.Option(metavar="text|json", help="format of events on standard error")] = "text",
) -> int:
    """Run the server. It requires a token, which is part of the URL that it prints."""
    from client.options.serve_options import (
        ServeOptions,
        authenticator_of,
        certificate_of,
        data_folder,
        exit_soon,
        limits_of,
        log_format_of,
        objects_folder,
    )
    from server.service.edge.listening import ServeError
    from server.service.keeper import CAN_KEEP, keep, kept
    from server.service.monitoring.console import console_of
    from server.service.monitoring.event_log import log_events

    keeper = kept()
    options = ServeOptions(
        new_token=None if keeper is None else keeper.token,
        host=host,
        token=token,
        token_file=token_file,
        insecure=insecure,
        allow_origin=tuple(allow_origin or ()),
        trusted_proxy=tuple(trusted_proxy or ()),
        tls=tls,
        tls_cert=tls_cert,
        tls_key=tls_key,
        volume_memory=volume_memory,
        sessions=sessions,
        sessions_per_address=sessions_per_address,
        data_gib=data_gib,
        data_days=data_days,
    )
    limits, authenticator, log_format = limits_of(options), authenticator_of(options), log_format_of(log)
    certificate = certificate_of(options)
    log_events(log_format)
    if restart and keeper is None and CAN_KEEP:
        try:
            keep(host, port, log_format)
        except ServeError as error:
            raise RunError(str(error)) from error
    from server.service.serve import serve as serve_forever

    console = console_of(log_format, is_token_given=(token or token_file) is not None)
    status = serve_forever(
        host,
        port,
        device,
        data=data_folder(data),
        limits=limits,
        authenticator=authenticator,
        certificate=certificate,
        objects=objects_folder(objects),
        say=console.say,
        shows_token=console.shows_token,
        keeper=keeper,
        draws_code=console.draws,
    )
    exit_soon(status)
    return status


@app.command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="output folder")] = Path("out/demo"),
    keep: Annotated[bool, typer.Option("--keep", help="keep the server running for the page")] = False,
    port: Annotated[int, typer.Option(min=0, max=65535, help="port of the page; 0: any free port")] = 0,
    device: o.DeviceOption = None,
) -> None:
    """Run server and client on a synthetic scene; pictures in out/demo."""
    from client.commands.demo import run_demo

    run_demo(out, device, keep, port)


@app.command()
def model(
    source: o.SourceArgument,
    out: Annotated[Path, typer.Option(metavar="FILE", help="output file: .ply (world axes) or .glb (+y up)")],
    frames: o.Frames = None,
    voxel: o.Voxel = None,
) -> None:
    """Reconstruct a triangle mesh of a static scene from posed frames, offline."""
    from client.static_model.model import check_output, model_of_source, open_posed, write_model

    check_output(out)
    opened, chosen, cell_m = open_posed(source, frames, voxel)
    done = model_of_source(opened, chosen, cell_m, track)
    write_model(done.mesh, out)
    counts = f"{len(chosen)} frames, {done.points} points, {len(done.mesh.triangles)} triangles"
    say(f"{counts}, {done.flipped} normals flipped towards the camera, written to {out}")


@app.command()
def devices() -> None:
    """List the OpenCL devices and the default one."""
    from client.commands.devices import show_devices

    show_devices()


@app.command()
def tune(device: o.DeviceOption = None) -> None:
    """Measure accuracy against time on this device, for --budget-ms, --max-light-error and --preset auto.

    Without --device it also says which device of this machine is the fastest.
    """
    from client.tuning.devices import comparison
    from client.tuning.tune import lines_of
    from client.tuning.tune import tune as measure
    from server.opencl.device import open_device
    from server.quality.pareto_front import write_front

    opened = open_device(device)
    with progress_bar("points") as progress:
        front = measure(opened, progress)
    for line in lines_of(front):
        say(line)
    say(f"kept in {write_front(front)}")
    if device is None:
        for line in comparison(opened, note):
            say(line)


@app.command()
def bench(
    suite: Annotated[str, typer.Argument(metavar="SUITE", help="name of the suite")],
    json: Annotated[bool, typer.Option("--json", help="print one JSON object")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="fewer frames and trials")] = False,
    scenes: Annotated[
        str | None, typer.Option(metavar="LIST", help="suite accuracy: scenes; default: all that are available")
    ] = None,
    engine: Annotated[
        str | None, typer.Option(metavar="serial|ray", help="suite accuracy: where points are measured")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="suite accuracy: output folder; default: out/bench/accuracy")
    ] = None,
    device: o.DeviceOption = None,
) -> None:
    """Run a benchmark suite and compare with its goals."""
    from client.commands.bench import run_bench

    run_bench(suite, json, quick, {"scenes": scenes, "engine": engine, "out": out, "device": device})
