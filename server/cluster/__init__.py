"""Several machines with Ray Serve (extra `cluster`): ingress replicas hold the sockets; each room is a process.

Serve runs `application`. `ingress` (ASGI) finds the room of a client's first message in the `room_directory` and relays
messages (`relay`). `host` is a room's process, an ordinary service. `room_supervisor` closes empty rooms and requests
capacity according to `capacity`, which `simulation` evaluates over a day.
"""
