"""Two programs in one room: one scans and places an object, one only looks on: `python share_a_room.py URL`."""

import asyncio
import sys

from stream_frames import CAMERA, my_frames

from client.streaming.client import Answer, RoomPlace, StreamClient
from protocol.messages import Light, Wishes

TRIANGLE = b"v 0 0 0\nv 0.2 0 0\nv 0 0.2 0\nf 1 2 3\n"


async def scan(url: str, room: RoomPlace, count: int) -> int:
    """Streams; times that a lost connection was restored."""
    client = await StreamClient.connect(url)
    wishes = Wishes(poses="given", volume_m=(-1.0, -1.0, 0.5, 1.0, 1.0, 2.5), voxel_m=0.01)
    # A connection that is lost comes back by itself within keep_s: room, objects and light are still there.
    await client.hello(CAMERA, wishes, client="scanner", room=room, keep_s=30.0)
    done = await client.place_object("my-triangle", "obj", TRIANGLE, position_m=(0.0, 0.3, 1.4))
    if done.error is not None:
        raise SystemExit(done.error)
    for frame in my_frames(count):
        await client.send_frame(frame)
    await client.wait_until_answered()
    await client.close()
    return client.reconnected


async def look_on(url: str, room: RoomPlace, ready: asyncio.Event) -> Light:
    """The first light that the room's scanner gets: what a renderer of one's own needs."""
    client = await StreamClient.connect(url)
    await client.watch(room=room.name, room_key=room.key)
    ready.set()
    async for answer in client.answers():
        if isinstance(answer, Answer):
            await client.close()
            return answer.light
    raise SystemExit("the scanner left before it had a light")


async def main(url: str, count: int = 5) -> Light:
    room = RoomPlace("kitchen", key="only for us")
    ready = asyncio.Event()
    looking = asyncio.create_task(look_on(url, room, ready))
    await ready.wait()
    await scan(url, room, count)
    light = await looking
    print(f"27 floats for THREE.LightProbe: {[round(value, 3) for value in light.sh_webxr]}")
    return light


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
