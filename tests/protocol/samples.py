"""One of every message, and random ones: what the protocol's tests encode and decode."""

from __future__ import annotations

import numpy as np

from protocol.frames import CameraModel, DepthCamera
from protocol.messages import (
    Acknowledged,
    ArrivingLight,
    Bye,
    ClientMessage,
    ColorImage,
    Composite,
    DepthImage,
    DirectedLight,
    Dropped,
    Error,
    Frame,
    Hello,
    Lamp,
    Layer,
    LayerPatch,
    LeftOut,
    Light,
    LightPlace,
    Marker,
    MeshPart,
    MoveObject,
    OperatingPoint,
    Panorama,
    PlacedObject,
    PlaceObject,
    Plan,
    Quality,
    RemoveObject,
    RequestMesh,
    RequestPanorama,
    ServerMessage,
    Spot,
    Timings,
    Watch,
    Welcome,
    Wishes,
)

IDENTITY = tuple(float(row == column) for row in range(4) for column in range(4))
CAMERA = CameraModel(width=64, height=48, fx=50.0, fy=50.5, cx=31.5, cy=23.5)
TWO_LENSES = CameraModel(
    width=64,
    height=48,
    fx=50.0,
    fy=50.5,
    cx=31.5,
    cy=23.5,
    distortion=(0.1, -0.05, 0.001, 0.002, 0.01),
    depth=DepthCamera(
        width=32,
        height=24,
        fx=26.0,
        fy=26.5,
        cx=15.25,
        cy=11.75,
        distortion=(-0.2, 0.1, 0.0, 0.0, 0.0),
        color_from_depth=(1.0, 0.0, 0.0, 0.075, 0.0, 0.8, -0.6, 0.0, 0.0, 0.6, 0.8, -0.001, 0.0, 0.0, 0.0, 1.0),
    ),
)
COLOR = ColorImage(width=2, height=1, codec="raw", data=bytes(range(6)))
DEPTH = DepthImage(width=2, height=1, codec="raw", data=b"\xe8\x03\x00\x00")

CLIENT: dict[str, ClientMessage] = {
    "hello": Hello(
        client="laptop",
        camera=CAMERA,
        wishes=Wishes(
            preset="art4",
            volume_m=(-1.0, -1.0, 0.0, 1.0, 1.0, 2.0),
            up=(0.0, -1.0, 0.0),
            ray_length_m=0.1,
            albedo="constant",
            indirect="none",
            light=((1.0, 0.5, 0.25),),
            light_axes="webxr",
            lamps="on",
        ),
    ),
    "hello_light_at": Hello(
        client="laptop", camera=CAMERA, wishes=Wishes(light_at=((0.5, 0.25, -1.5), (1.0, 0.0, 2.0)))
    ),
    "hello_two_lenses": Hello(client="rig", camera=TWO_LENSES),
    "hello_room": Hello(
        client="tablet",
        camera=TWO_LENSES,
        room="kitchen",
        room_from_world=IDENTITY,
        marker=Marker(id=7, side_m=0.125, dictionary="apriltag_36h11"),
        keep_s=30.0,
    ),
    "hello_resume": Hello(client="tablet", camera=TWO_LENSES, resume="k3y"),
    "watch": Watch(),
    "watch_room": Watch(room="kitchen"),
    "watch_named": Watch(session="küche"),
    "frame": Frame(frame=7, timestamp_s=0.25, world_from_camera=IDENTITY, color=COLOR, depth=DEPTH),
    "frame_with_exposure": Frame(
        frame=9, timestamp_s=0.75, world_from_camera=IDENTITY, color=COLOR, depth=DEPTH, exposure=0.0078125
    ),
    "frame_without_pose": Frame(frame=8, timestamp_s=0.5, world_from_camera=None, color=COLOR, depth=DEPTH),
    "place_object": PlaceObject(request=1, object="sofa", format="glb", data=b"glTF\x02", position_m=(0.5, 0.25, 1.5)),
    "place_object_on_pixel": PlaceObject(
        request=8, object="sofa", format="glb", data=b"glTF", spot=Spot(on="pixel", pixel=(320.0, 120.5), frame=12)
    ),
    "place_object_on_ray": PlaceObject(
        request=9,
        object="sofa",
        format="obj",
        data=b"v",
        scale=2.0,
        yaw_deg=-45.0,
        spot=Spot(on="ray", origin_m=(0.5, 1.5, 0.0), direction=(0.0, -0.5, -1.0)),
    ),
    "place_object_on_table": PlaceObject(
        request=10, object="vase", format="ply", data=b"ply", spot=Spot(on="table"), height_m=0.25
    ),
    "move_object": MoveObject(request=2, object="sofa", position_m=(0.0, 0.0, 1.0), scale=2.0, yaw_deg=-90.0),
    "remove_object": RemoveObject(request=3, object="sofa"),
    "quality": Quality(request=4, preset="auto", budget_ms=40.0),
    "request_mesh": RequestMesh(request=5),
    "request_panorama": RequestPanorama(request=6, format="exr"),
    "request_panorama_at": RequestPanorama(request=7, format="hdr", position_m=(0.5, 0.25, -1.5)),
    "client_bye": Bye(reason="the sequence is over"),
}

SERVER: dict[str, ServerMessage] = {
    "welcome": Welcome(session="kitchen", server="probeless 0.1.0", device="PoCL CPU", max_inflight=2),
    "welcome_codecs": Welcome(
        session="session-4",
        server="probeless 0.1.0",
        device="PoCL CPU",
        max_inflight=2,
        codecs=("jpeg", "png", "raw", "h264"),
        depth_codecs=("raw", "zdelta", "zranks", "zstd-delta", "zstd-ranks"),
    ),
    "welcome_back": Welcome(
        session="session-1",
        server="probeless 0.1.0",
        device="PoCL CPU",
        max_inflight=2,
        key="k3y",
        resumed=True,
        room="a",
    ),
    "composite": Composite(
        frame=7,
        timestamp_s=0.25,
        color=COLOR,
        world_from_camera=IDENTITY,
        tracking="given",
        timings=Timings(input=1.5, reconstruct=12.25, total=20.0),
        plan=Plan(
            run=("transfer_radiance", "composite"),
            left_out=(
                LeftOut(effect="shadow", reason="no object is near a surface", error_bound=0.5),
                LeftOut(effect="gloss", reason="not modelled", error_bound=None),
            ),
            point=OperatingPoint(
                settings="--preset reg8 --rays 49",
                reason="the most accurate that is expected within the budget of 150 ms",
                expected_ms=131.5,
                light_error_deg=3.25,
            ),
        ),
        notes=("depth is missing in 31 % of the pixels",),
        placed=(PlacedObject(object="vase", position_m=(0.5, 0.25, -1.0), scale=0.5, yaw_deg=30.0),),
    ),
    "layer": Layer(
        frame=7,
        timestamp_s=0.25,
        virtual=LayerPatch(x=3, y=5, color=COLOR, depth=DEPTH),
        ratio=None,
        depth_scale_m=0.001,
        world_from_camera=IDENTITY,
        tracking="given",
        timings=Timings(rendering=1.5, total=20.0),
        plan=Plan(run=("compose_layer",), left_out=()),
    ),
    "light": Light(
        frame=7,
        timestamp_s=0.25,
        sh=tuple((k / 4, -k / 8, 0.125) for k in range(16)),
        sh_std=tuple((0.5, 0.25, None) for _ in range(16)),
        sh_webxr=tuple(k / 16 for k in range(27)),
        dominant_direction=(0.0, 0.6, -0.8),
        dominant_intensity=1.25,
        dominant_lights=(DirectedLight(direction=(0.0, 0.6, -0.8), irradiance=(1.5, 1.25, 1.0), spread_deg=12.5),),
        lamps=(
            Lamp(
                position_m=(0.5, 1.25, -0.75),
                position_std_m=(0.01, 0.02, 0.04),
                intensity=(2.5, 2.0, 1.25),
                intensity_std=(0.25, 0.125, 0.0625),
                share=0.75,
            ),
        ),
        condition=None,
        valid=True,
    ),
    "light_of_an_exposure": Light(
        frame=9,
        timestamp_s=0.75,
        sh=tuple((k / 4, -k / 8, 0.125) for k in range(16)),
        sh_std=((None, None, None),) * 16,
        sh_webxr=tuple(k / 16 for k in range(27)),
        dominant_direction=(0.0, 0.6, -0.8),
        dominant_intensity=1.25,
        exposure=1.5,
        up=(0.0, -0.6, 0.8),
        condition=12.5,
        valid=False,
    ),
    "light_at_places": Light(
        frame=10,
        timestamp_s=1.0,
        sh=tuple((k / 4, -k / 8, 0.125) for k in range(16)),
        sh_std=((None, None, None),) * 16,
        sh_webxr=tuple(k / 16 for k in range(27)),
        dominant_direction=(0.0, 0.6, -0.8),
        dominant_intensity=1.25,
        condition=12.5,
        valid=True,
        spread_deg=12.5,
        position=(0.25, 0.5, 1.75),
        at=(
            ArrivingLight(
                of="view",
                index=0,
                position=(0.25, 0.5, 1.75),
                sh=tuple((k / 2, k / 8, 0.25) for k in range(16)),
                sh_std=tuple((0.5, 0.25, 0.125) for _ in range(16)),
                sh_webxr=tuple(k / 32 for k in range(27)),
                dominant_direction=(0.6, 0.0, -0.8),
                dominant_intensity=0.75,
                spread_deg=8.25,
                valid=True,
                seen=0.375,
            ),
            ArrivingLight(
                of="object",
                index=0,
                position=(-0.25, 0.5, 1.5),
                sh=tuple((k / 4, k / 16, 0.5) for k in range(16)),
                sh_std=((None, None, None),) * 16,
                sh_webxr=tuple(k / 64 for k in range(27)),
                dominant_direction=(0.0, 0.0, 0.0),
                dominant_intensity=0.0,
                spread_deg=None,
                valid=False,
                object="sofa",
            ),
        ),
    ),
    "panorama": Panorama(request=6, format="exr", position_m=(-0.25, 0.5, 1.5), data=b"\x76\x2f\x31\x01"),
    "dropped": Dropped(frame=6, reason="replaced by a newer frame"),
    "mesh_part": MeshPart(request=5, format="ply", size_bytes=9, offset=4, data=b"\nend\n"),
    "acknowledged": Acknowledged(request=1, notes=("no normals: computed",)),
    "acknowledged_error": Acknowledged(request=2, error="there is no object 'chair'"),
    "error": Error(reason="not a valid message", fatal=True),
    "server_bye": Bye(reason="shutting down"),
}


def random_frame(random: np.random.Generator) -> Frame:
    """A frame with every field drawn at random within what the types allow."""
    width, height = (int(side) for side in random.integers(1, 40, 2))
    pose = np.eye(4)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    pose[:3, :3] = turn * np.sign(np.linalg.det(turn))
    pose[:3, 3] = random.uniform(-1, 1, 3) * 10.0 ** random.integers(-6, 5)
    return Frame(
        frame=int(random.integers(0, 2**53, endpoint=True)),
        timestamp_s=float(random.normal(0, 1e6)),
        world_from_camera=None if random.random() < 0.3 else tuple(pose.ravel().tolist()),
        color=ColorImage(width=width, height=height, codec="jpeg", data=random.bytes(random.integers(0, 5000))),
        depth=DepthImage(width=width, height=height, codec="zdelta", data=random.bytes(random.integers(0, 5000))),
        exposure=None if random.random() < 0.5 else float(random.exponential()),
    )


def random_light(random: np.random.Generator) -> Light:
    """A light with every number drawn at random, some deviations unknown."""

    def rgb() -> tuple[float, float, float]:
        red, green, blue = random.normal(0, 3, 3).tolist()
        return red, green, blue

    more = tuple(rgb() for _ in range(36))
    return Light(
        frame=int(random.integers(0, 2**53)),
        timestamp_s=float(random.uniform(0, 1e4)),
        sh=more[:16],
        sh_all=None if random.random() < 0.5 else more,
        sh_std=tuple((None, *rgb()[:2]) for _ in range(16)),
        sh_webxr=tuple(random.normal(0, 3, 27).tolist()),
        dominant_direction=rgb(),
        dominant_intensity=float(random.exponential()),
        dominant_lights=tuple(
            DirectedLight(direction=rgb(), irradiance=rgb(), spread_deg=float(random.exponential()))
            for _ in range(random.integers(0, 4))
        ),
        lamps=tuple(
            Lamp(position_m=rgb(), position_std_m=rgb(), intensity=rgb(), intensity_std=rgb(), share=random.random())
            for _ in range(random.integers(0, 3))
        ),
        exposure=float(random.exponential()),
        condition=None if random.random() < 0.5 else float(random.exponential(1e6)),
        valid=bool(random.random() < 0.5),
        spread_deg=None if random.random() < 0.5 else float(random.uniform(0, 180)),
        position=None if random.random() < 0.5 else rgb(),
        at=tuple(_random_arriving(random) for _ in range(random.integers(0, 4))),
    )


def _random_arriving(random: np.random.Generator) -> ArrivingLight:
    of: tuple[LightPlace, ...] = ("view", "place", "object")
    return ArrivingLight(
        of=of[random.integers(3)],
        index=int(random.integers(0, 100)),
        position=tuple(random.normal(0, 3, 3).tolist()),
        sh=tuple(tuple(row) for row in random.normal(0, 3, (16, 3)).tolist()),
        sh_std=tuple((None, row[0], row[1]) for row in random.normal(0, 3, (16, 2)).tolist()),
        sh_webxr=tuple(random.normal(0, 3, 27).tolist()),
        dominant_direction=tuple(random.normal(0, 1, 3).tolist()),
        dominant_intensity=float(random.exponential()),
        spread_deg=None if random.random() < 0.5 else float(random.uniform(0, 180)),
        valid=bool(random.random() < 0.5),
        seen=None if random.random() < 0.5 else float(random.random()),
        object=None if random.random() < 0.5 else "sofa",
    )
