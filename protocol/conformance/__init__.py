"""Whether a server, or a client, keeps to the wire page: `python -m protocol.conformance`. Needs no part of ours."""
