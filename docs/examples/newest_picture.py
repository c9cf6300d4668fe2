"""Shows a virtual thing in a camera's newest picture, and waits for no server: `python newest_picture.py URL`."""

import asyncio
import sys

import numpy as np
from stream_frames import CAMERA, my_frames

from client.display.layers import DecodedLayer, decode_layer, put_over
from client.streaming.client import Answer, StreamClient
from protocol.messages import Wishes

SIGN = b"v -1 0 0 1 .2 .1\nv 1 0 0 1 .2 .1\nv 0 2 0 1 .2 .1\nf 1 2 3\nf 3 2 1\n"  # each corner: place and colour


async def main(url: str, count: int = 40) -> list[np.ndarray]:
    client = await StreamClient.connect(url)
    bounds = {"volume_m": (-1.0, -1.0, 0.5, 1.0, 1.0, 2.5), "voxel_m": 0.01, "up": (0.0, -1.0, 0.0)}
    await client.hello(CAMERA, Wishes(answer="layer", **bounds), client="my program")
    await client.place_object("sign", "obj", SIGN, position_m=(0.0, 0.2, 1.2), scale=0.2)
    layer: DecodedLayer | None = None

    async def receive() -> None:
        nonlocal layer
        async for answer in client.answers():
            if isinstance(answer, Answer) and answer.layer is not None:
                layer = decode_layer(answer.layer, CAMERA)

    receiving = asyncio.create_task(receive())
    pictures: list[np.ndarray] = []
    for frame in my_frames(1000):
        if client.has_room:
            await client.send_frame(frame)
        if layer is not None:  # of an earlier frame: it is moved to where the camera is now
            picture = put_over(layer, frame.color, CAMERA, frame.world_from_camera)
            pictures.append(picture)  # yours go to the screen
        if len(pictures) == count:
            break
        await asyncio.sleep(1 / 30)
    await client.wait_until_answered()
    await client.close()
    await receiving
    changed = sum(bool((picture != picture[0, 0]).any()) for picture in pictures)
    print(f"{changed} of {len(pictures)} pictures have the sign in them")
    return pictures


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
