"""The package as the author of a protocol sees it."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import zbridge.protocol

ROOT = Path(__file__).parents[2]
GATEWAYS = sorted(
    path
    for path in (ROOT / "gateways").glob("*/**/*.py")
    if path.name != "__main__.py" and "conformance" not in path.parts
)
AUTHORS = {"zbridge.protocol", "zbridge.wire", "zbridge.fleet"}
SIMULATORS = {"zbridge.simulation", "zbridge.transport"}

FRESH = """
import sys
import msgpack, msgspec, numpy
theirs = set(sys.modules)
import zbridge.protocol, zbridge.fleet, zbridge.wire, zbridge.fleet.view, zbridge.fleet.messages, zbridge.fleet.topics
print(*sorted({"asyncio", "socket", "threading", "zenoh", "uvloop"} & (set(sys.modules) - theirs)))
"""


def test_importing_it_loads_no_event_loop_no_socket_no_thread_and_no_bus() -> None:
    ran = subprocess.run([sys.executable, "-c", FRESH], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == ""


def test_its_docstring_is_the_table_of_its_contents() -> None:
    described = zbridge.protocol.__doc__ or ""
    assert [name for name in zbridge.protocol.__all__ if f"`{name}`" not in described] == []


def test_it_exports_what_it_says() -> None:
    assert [name for name in zbridge.protocol.__all__ if not hasattr(zbridge.protocol, name)] == []


@pytest.mark.parametrize("path", GATEWAYS, ids=lambda path: ".".join(path.relative_to(ROOT).parts))
def test_a_gateway_is_written_with_the_authors_packages_alone(path: Path) -> None:
    allowed = AUTHORS | (SIMULATORS if "simulator" in path.stem else set())
    imported = {
        node.module
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and node.module is not None and node.module.startswith("zbridge")
    }
    rooms = {".".join(name.split(".")[:2]) for name in imported}
    assert rooms <= allowed
    assert not {name for name in imported if name.startswith("zbridge.protocol.")}
