"""Renders the chart with Helm's library, and checks the result.

Usage: chart.py HELM-FOLDER OUTPUT, which creates the folder OUTPUT; chart.py --same A B, which exits with 0 if both
files contain the same objects.
"""

import subprocess
import sys
from pathlib import Path
from typing import Any

import helm_python as helm
import kubernetes_validate
import yaml

KUBERNETES = ("1.25", "1.29", "1.33", "1.37")
ROBOT = {"secret": "a", "device": {"protocol": "alf", "connect": ["tcp://10.0.0.1:6666"]}}
WRONG: dict[str, dict[str, Any]] = {
    "an unknown key": {"nonsense": 1},
    "a robot without a certificate": {"robots": {"r1": {"device": ROBOT["device"]}}},
    "a robot that is neither robot nor listener": {"robots": {"r1": {"secret": "a"}}},
    "a name that is invalid in keys": {"robots": {"r 1": ROBOT}},
    "a router without TLS": {"router": {"connect": ["tcp/hub:7447"]}},
    "an invalid network": {"networkPolicy": {"routerFrom": ["lab"]}},
    "a listener at one address": {
        "robots": {"r1": {**ROBOT, "hq": [{"protocol": "alf", "listen": "tcp://127.0.0.1:1"}]}}
    },
    "no bus": {"router": {"enabled": False}, "robots": {"r1": ROBOT}},
}

Object = dict[str, Any]


def identity(item: Object) -> tuple[str, str]:
    """Return kind and name, which identify an object."""
    return item["kind"], item["metadata"]["name"]


def objects(text: str) -> list[Object]:
    """Read objects, sorted by kind and name."""
    return sorted((item for item in yaml.safe_load_all(text) if item), key=identity)


def render(folder: Path, values: Object) -> str:
    """Render the chart as `helm template zb` does; raise HelmError."""
    with helm.Chart.load(str(folder / "zbridge")) as chart:
        found = chart.render(values, name="zb", namespace="default")
    return "\n---\n".join(text for path, text in found.items() if path.endswith(".yaml"))


def check_pods(items: list[Object]) -> None:
    """Check that every pod is confined, and has limits and a network policy of its own."""
    policies = [item["spec"]["podSelector"]["matchLabels"] for item in items if item["kind"] == "NetworkPolicy"]
    for item in items:
        if item["kind"] != "Deployment":
            continue
        pod = item["spec"]["template"]["spec"]
        assert pod["securityContext"]["runAsNonRoot"] and not pod["automountServiceAccountToken"], identity(item)
        assert item["spec"]["selector"]["matchLabels"] in policies, identity(item)
        for container in pod["containers"]:
            limits, context = container["resources"]["limits"], container["securityContext"]
            assert context["readOnlyRootFilesystem"] and context["capabilities"]["drop"] == ["ALL"], identity(item)
            assert limits["memory"], identity(item)
            assert "livenessProbe" in container or item["metadata"]["name"] == "zb-recorder", identity(item)


def zbridge(*words: str | Path) -> None:
    """Run a command of zbridge; show its errors if it fails."""
    done = subprocess.run([sys.executable, "-m", "zbridge", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def check_files(items: list[Object], output: Path) -> int:
    """Run `zbridge check` on the robots' files, each with a certificate of its robot; return their number."""
    zbridge("certs", "init", output / "certs")
    issue = ("certs", "issue", "--dir", output / "certs")
    zbridge(*issue, "hub", "--role", "router", "--host", "zb-router")
    count = 0
    for item in items:
        for name, text in item.get("data", {}).items() if item["kind"] == "ConfigMap" else ():
            if name == "router.toml":
                continue
            robot, bundle = name.removesuffix(".toml"), output / name.removesuffix(".toml")
            zbridge(*issue, robot, "--role", "gateway", "--robot", robot)
            zbridge("certs", "bundle", "--dir", output / "certs", robot, "-o", bundle)
            (output / name).write_text(text.replace("/etc/zbridge/bus/", f"{bundle}/"))
            zbridge("check", output / name)
            count += 1
    return count


def main(folder: Path, output: Path) -> None:
    """Check the chart as a whole."""
    output.mkdir()
    found = helm.lint(str(folder / "zbridge"))
    assert not found["errors"] and all(message["severity"] < 2 for message in found["messages"]), found
    for values in ({}, yaml.safe_load((folder / "example.yaml").read_text())):
        text = render(folder, values)
        items = objects(text)
        for version in KUBERNETES:
            for item in items:
                kubernetes_validate.validate(item, version, strict=True)
        check_pods(items)
        versions = ", ".join(KUBERNETES)
        print(f"ok: Helm {helm.helm_sdk_version()}: {len(items)} objects match the schemas of Kubernetes {versions}")
    (output / "all.yaml").write_text(text)
    print(f"ok: {check_files(items, output)} robot files pass zbridge check")
    for what, values in WRONG.items():
        try:
            render(folder, values)
        except helm.HelmError:
            continue
        raise AssertionError(f"{what} is accepted")
    print(f"ok: {len(WRONG)} wrong values are rejected")


if sys.argv[1] == "--same":
    one, other = (objects(Path(name).read_text()) for name in sys.argv[2:])
    sys.exit(one != other)
main(Path(sys.argv[1]), Path(sys.argv[2]))
