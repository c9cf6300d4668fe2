"""Command line, Python client and web page."""

import os

# Its threads busy-wait and take cores from PoCL. NumPy reads the variable only when it is first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
