"""Whether the server of this container is ready: its own words, and exit status 0 or 1."""

from __future__ import annotations

import os
import ssl
import sys
import urllib.error
import urllib.request

PATIENCE_S = 4.0


def main() -> int:
    """Ask the server on this machine, which may speak TLS with a certificate that nobody else vouches for."""
    port = os.environ.get("PROBELESS_PORT", "8080")
    said = "nothing listens"
    for scheme in ("http", "https"):
        try:
            said = _asked(f"{scheme}://127.0.0.1:{port}/healthz")
        except urllib.error.HTTPError as error:
            sys.stdout.write(error.read().decode(errors="replace") + "\n")
            return 1
        except (OSError, ValueError) as error:
            said = f"no answer at port {port}: {error}"
        else:
            sys.stdout.write(said + "\n")
            return 0
    sys.stdout.write(said + "\n")
    return 1


def _asked(url: str) -> str:
    # Only this machine is asked, so there is nobody to take for somebody else.
    opener = urllib.request.build_opener(
        urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=ssl._create_unverified_context())
    )
    with opener.open(url, timeout=PATIENCE_S) as answer:
        return str(answer.read().decode())


if __name__ == "__main__":
    sys.exit(main())
