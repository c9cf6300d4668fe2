"""Thin clients and the command line."""

import os

# Its threads wait in busy loops, and take the cores from PoCL's. NumPy reads this once, when it is first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
