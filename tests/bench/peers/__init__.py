"""Those that are measured side by side: this program and its peers, each behind the same small interface.

`contestant.py` is that interface, `worker.py` gives each one a process of its own, one file a library does the rest.
"""
