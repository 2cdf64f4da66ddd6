"""The installed ``zbridge``: its version, what shells complete with it, and what ``zbridge run FILE`` does not load."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import zbridge

ROOT = Path(__file__).parents[2]
SCRIPT = Path(sys.executable).with_name("zbridge")
LOADED = """\
import sys
from zbridge.cli import main
sys.argv = ["zbridge", "run", "missing.toml"]
try:
    main()
finally:
    print(*({"typer", "rich", "click"} & set(sys.modules)))
"""


def ran(*command: str | Path, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def completed(shell: str, line: str) -> str:
    """Ask for completions as the script that ``--install-completion`` installs does, without arguments."""
    words = line.split(" ")
    variables = {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1), "_TYPER_COMPLETE_ARGS": line}
    given = ran(SCRIPT, _ZBRIDGE_COMPLETE=f"complete_{shell}", **variables)
    assert (given.returncode, given.stderr) == (0, "")
    return given.stdout


def test_the_version_is_that_of_the_package() -> None:
    told = ran(sys.executable, "-m", "zbridge", "--version")
    assert (told.returncode, told.stdout, told.stderr) == (0, f"zbridge {zbridge.__version__}\n", "")


@pytest.mark.skipif(not SCRIPT.exists(), reason="zbridge is not installed here")
@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_shell_completes_commands_options_and_protocols(shell: str) -> None:
    commands = completed(shell, "zbridge re")
    assert all(name in commands for name in ("record", "replay", "restart"))
    assert "simulate" not in commands
    assert "tcpudp" in completed(shell, "zbridge simulate t")
    assert "--sessions" in completed(shell, "zbridge ls --se")


@pytest.mark.skipif(not SCRIPT.exists(), reason="zbridge is not installed here")
def test_bash_gets_a_function_that_asks_the_installed_program() -> None:
    script = ran(SCRIPT, _ZBRIDGE_COMPLETE="source_bash").stdout
    words = "COMP_WORDS=(zbridge simulate w); COMP_CWORD=2"
    asked = ran("bash", "-c", f'{script}\n{words}\n_zbridge_completion {SCRIPT}\necho "${{COMPREPLY[@]}}"')
    assert (asked.stdout, asked.stderr) == ("wc2ec\n", "")


def test_run_of_one_file_loads_neither_typer_nor_rich() -> None:
    told = ran(sys.executable, "-c", LOADED)
    assert (told.returncode, told.stdout) == (2, "\n")
    assert told.stderr.startswith("zbridge: missing.toml: ")
