"""What a server says over HTTP."""

import httpx
from prometheus_client.parser import text_string_to_metric_families

from tests.service.fakes import PATIENCE_S


def get(server, path: str) -> httpx.Response:
    return httpx.get(server.url + path, trust_env=False, timeout=PATIENCE_S)


def rows(server) -> dict[tuple[str, ...], float]:
    """Every sample of /metrics, by name and label values, as another library reads it."""
    families = text_string_to_metric_families(get(server, "/metrics").text)
    return {(s.name, *s.labels.values()): s.value for family in families for s in family.samples}
