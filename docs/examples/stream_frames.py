"""Streams frames of a program's own to a probeless server and uses the light: `python stream_frames.py URL`."""

import asyncio
import sys
from collections.abc import Iterator

import numpy as np

from client.streaming.client import Answer, StreamClient
from protocol.frames import CameraModel, RgbdFrame
from protocol.images import decode_color
from protocol.messages import Light, Wishes

CAMERA = CameraModel(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5, depth_scale_m=0.001)


def my_frames(count: int) -> Iterator[RgbdFrame]:
    """Yours come from a camera: sRGB, depth in units of `depth_scale_m` (0: none), and where the camera is."""
    for index in range(count):
        color = np.full((120, 160, 3), 180, np.uint8)
        depth = np.full((120, 160), 1500, np.uint16)
        world_from_camera = np.eye(4)  # x right, y down, z forward; metres. None: the server tracks
        yield RgbdFrame(index, index / 30, color, depth, world_from_camera)


def light_on(light: Light, normal: tuple[float, float, float]) -> np.ndarray:
    """[3] RGB of a white surface that faces `normal` (world, unit): bands 0 to 2 of the 16 coefficients suffice."""
    x, y, z = normal
    basis = [0.282095, 0.488603 * y, 0.488603 * z, 0.488603 * x]
    basis += [1.092548 * x * y, 1.092548 * y * z, 0.315392 * (3 * z * z - 1), 1.092548 * x * z]
    basis += [0.546274 * (x * x - y * y)]
    lambert = [1.0] + 3 * [2 / 3] + 5 * [1 / 4]  # the cosine's weight of each band, over pi
    return np.asarray(light.sh)[:9].T @ (np.array(basis) * lambert)


async def main(url: str, count: int = 5) -> list[Light]:
    client = await StreamClient.connect(url)
    wishes = Wishes(poses="given", volume_m=(-1.0, -1.0, 0.5, 1.0, 1.0, 2.5), voxel_m=0.01, up=(0.0, -1.0, 0.0))
    await client.hello(CAMERA, wishes, client="my program")

    async def send() -> None:
        for frame in my_frames(count):
            await client.wait_for_room()  # a live camera takes its newest frame here
            await client.send_frame(frame)
        await client.wait_until_answered()
        await client.close()  # ends the loop below

    sending = asyncio.create_task(send())
    lights = []
    async for answer in client.answers():
        if isinstance(answer, Answer):  # else a frame that was dropped, or an error that is not fatal, with its reason
            picture = decode_color(answer.composite.color, CAMERA, "srgb8")
            above = light_on(answer.light, (0.0, -1.0, 0.0))
            known = "known" if answer.light.valid else "not fixed yet"
            print(f"frame {answer.light.frame}: {picture.shape}, light from above {above.round(3)}, {known}")
            lights.append(answer.light)
    await sending
    return lights


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
