"""Child processes, each with one job: they have limits, and their crash does not affect the server."""
