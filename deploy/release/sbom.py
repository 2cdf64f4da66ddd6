"""Writes zbridge's SBOM from pyproject.toml: the declared dependencies with their ranges, in CycloneDX 1.6.

The wheel carries it (``.dist-info/sboms``, PEP 770). It lists what zbridge declares, not what an environment resolved:
the container image has an SBOM of its resolved versions. There is no date and no serial number, so that equal
declarations give equal bytes. Run it after every change of version or dependencies: python deploy/release/sbom.py
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
SBOM = Path(__file__).with_name("zbridge.cdx.json")
_NAME = re.compile(r"[A-Za-z0-9._-]+")


def render(project: dict[str, Any]) -> str:
    """Return the SBOM of a ``[project]`` table as JSON."""
    reference = f"pkg:pypi/{project['name']}@{project['version']}"
    components = _components(project)
    bom = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "component": {
                "type": "application",
                "bom-ref": reference,
                "name": project["name"],
                "version": project["version"],
                "description": project["description"],
                "licenses": [{"license": {"id": project["license"]}}],
                "purl": reference,
            },
            "lifecycles": [{"phase": "pre-build"}],
        },
        "components": components,
        "dependencies": [
            {"ref": reference, "dependsOn": [each["bom-ref"] for each in components]},
            *({"ref": each["bom-ref"]} for each in components),
        ],
        "compositions": [{"aggregate": "incomplete", "dependencies": [reference]}],
    }
    return json.dumps(bom, indent=2) + "\n"


def _components(project: dict[str, Any]) -> list[dict[str, Any]]:
    """List each dependency once, by name; its properties are the requirements that declare it."""
    declared: dict[str, list[tuple[str, str]]] = {}
    extras = {"": project["dependencies"], **project["optional-dependencies"]}
    for extra, requirements in extras.items():
        for requirement in requirements:
            name = _normalized(requirement)
            if name != project["name"]:  # an extra that names other extras
                declared.setdefault(name, []).append((extra, requirement))
    return [
        {
            "type": "library",
            "bom-ref": f"pkg:pypi/{name}",
            "name": name,
            "scope": "required" if "" in dict(uses) else "optional",
            "purl": f"pkg:pypi/{name}",
            "properties": [
                {"name": f"zbridge:requirement{f':{extra}' * bool(extra)}", "value": requirement}
                for extra, requirement in uses
            ],
        }
        for name, uses in sorted(declared.items())
    ]


def _normalized(requirement: str) -> str:
    name = _NAME.match(requirement)
    assert name is not None, requirement
    return re.sub(r"[-_.]+", "-", name[0]).lower()


if __name__ == "__main__":
    SBOM.write_text(render(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]))
    print(SBOM)
