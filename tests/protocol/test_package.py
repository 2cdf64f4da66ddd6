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
FORMATS = {"zbridge.ros2"}
"""What other programs put on Zenoh; sans-IO, like the author's packages."""
SIMULATORS = {"zbridge.simulation", "zbridge.transport"}


def test_importing_it_loads_no_event_loop_no_socket_no_thread_and_no_bus() -> None:
    ours = "import zbridge.protocol, zbridge.fleet, zbridge.wire, zbridge.fleet.view"
    others = '{"asyncio", "socket", "threading", "zenoh", "uvloop"} & (set(sys.modules) - theirs)'
    fresh = f"import sys, msgpack, msgspec, numpy; theirs = set(sys.modules); {ours}; print(*{others})"
    ran = subprocess.run([sys.executable, "-c", fresh], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == ""


def test_its_docstring_is_the_table_of_its_contents_and_it_exports_them() -> None:
    names = zbridge.protocol.__all__
    assert [name for name in names if f"`{name}`" not in zbridge.protocol.__doc__] == []
    assert [name for name in names if not hasattr(zbridge.protocol, name)] == []


@pytest.mark.parametrize("path", GATEWAYS, ids=lambda path: ".".join(path.relative_to(ROOT).parts))
def test_a_gateway_is_written_with_the_authors_packages_alone(path: Path) -> None:
    nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
    imported = [str(node.module) for node in nodes if str(node.module).startswith("zbridge")]
    rooms = {".".join(name.split(".")[:2]) for name in imported}
    assert rooms <= AUTHORS | FORMATS | (SIMULATORS if "simulator" in path.stem else set())
    assert not {name for name in imported if name.startswith("zbridge.protocol.")}
