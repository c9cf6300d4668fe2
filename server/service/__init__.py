"""The service: sockets, sessions, rooms that are kept, and the device that they share."""
