"""Whether the manifests pass the schemas that their own projects publish.

    python -m tests.docker.schemas compose-spec.json ray.io_rayservices.yaml

The first is `schema/compose-spec.json` of compose-spec/compose-go; the second, a CRD with its schema inside, is
`config/crd/bases/ray.io_rayservices.yaml` of KubeRay's ray-operator. Both can be had as Go modules. Needs jsonschema.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import yaml

from tests.docker.dockerfile import ROOT


def main() -> int:
    """0 if all hold."""
    compose, crd = (Path(name) for name in sys.argv[1:3])
    problems = [
        *complaints("compose.yaml", json.loads(compose.read_text()), without_extensions(ROOT / "docker/compose.yaml")),
        *complaints(
            "rayservice.yaml", schema_of(crd), yaml.safe_load((ROOT / "docker/cluster/rayservice.yaml").read_text())
        ),
    ]
    for line in problems or ["all hold"]:
        sys.stdout.write(line + "\n")
    return 1 if problems else 0


def complaints(name: str, schema: dict[str, Any], found: Any) -> Iterator[str]:
    """One line each."""
    for error in jsonschema.validators.validator_for(schema)(schema).iter_errors(found):
        yield f"{name}: {'/'.join(map(str, error.absolute_path))}: {error.message[:300]}"


def without_extensions(path: Path) -> Any:
    """As compose reads it, merges done; numbers that are durations stay text."""
    return yaml.safe_load(path.read_text())


def schema_of(crd: Path) -> dict[str, Any]:
    """Of the version that is stored, closed: a field that it does not name is a mistake, as for kubectl."""
    versions = yaml.safe_load(crd.read_text())["spec"]["versions"]
    schema = next(version["schema"]["openAPIV3Schema"] for version in versions if version["storage"])
    schema["properties"]["metadata"]["properties"] = {"name": {"type": "string"}}
    return closed(schema)


def closed(schema: Any) -> Any:
    """The same, refusing unknown fields wherever fields are named; int-or-string as JSON schema says it."""
    if isinstance(schema, list):
        return [closed(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    out = {name: closed(value) for name, value in schema.items()}
    names_fields = isinstance(schema.get("properties"), dict) and schema.get("type") == "object"
    if names_fields and not schema.get("x-kubernetes-preserve-unknown-fields"):
        out.setdefault("additionalProperties", False)
    return out


if __name__ == "__main__":
    sys.exit(main())
