"""Beyond one machine, on Ray Serve (extra `cluster`): replicas hold the sockets, each room is a process of its own.

`application` is what Serve runs: `ingress` (ASGI) finds the room of a client's first message through `places` and
relays bytes (`relay`); `host` is a room's process, an ordinary service; `keeper` closes rooms that nobody is in and
asks the cluster for as many places as `capacity` says. `simulation` plays a day against that.
"""
