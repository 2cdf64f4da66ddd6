"""The installer: what it is told wrongly, and what it copies. `deploy/try.sh host` runs it on a bare Debian."""

import os
import re
import subprocess
from pathlib import Path

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"
SCRIPT = DEPLOY / "install.sh"
SCRIPTS = sorted((*DEPLOY.glob("*.sh"), *DEPLOY.glob("*/*.sh")))
PARTS = [path for path in SCRIPTS if path.parent.name == "try" and os.access(path, os.X_OK)]


def install(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(("bash", str(SCRIPT), *arguments), capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--purge",), "--purge: requires --uninstall"),
        (("--nonsense",), "--nonsense: unknown option"),
        (("--wheels",), "--wheels: expected a path"),
    ],
)
def test_wrong_arguments_are_named_and_nothing_is_done(arguments: tuple[str, ...], told: str) -> None:
    done = install(*arguments)
    assert (done.returncode, done.stderr.splitlines()[0]) == (2, f"zbridge: {told}")


def test_help_names_every_option() -> None:
    options = set(re.findall(r"^        (--[a-z-]+)\)", SCRIPT.read_text(), re.MULTILINE))
    assert options
    assert options <= set(re.findall(r"--[a-z-]+", install("--help").stdout))


@pytest.mark.skipif(os.geteuid() == 0, reason="runs as root here")
def test_it_wants_to_be_root() -> None:
    assert install().stderr == "zbridge: must be run as root\n"


def test_every_file_that_it_copies_is_there() -> None:
    copied = set(re.findall(r"\$here/([\w/-]+\.\w+)", SCRIPT.read_text()))
    assert {"systemd/sysusers.conf", "zenoh/router.toml"} <= copied
    assert [name for name in copied if not (DEPLOY / name).is_file()] == []
    units = re.findall(r"zbridge[\w@-]*\.service", re.findall(r"all_units=\((.*)\)", SCRIPT.read_text())[0])
    assert sorted(units) == sorted(path.name for path in DEPLOY.glob("systemd/*.service"))


def test_what_is_installed_without_a_word_stays_what_it_is() -> None:
    """A configuration of the administrator is kept: only what is the package's own is written anew."""
    written = re.findall(r'^ *(?:if )?put "\$here/\S+" "?(\S+?)"?(?:;| \|\|)', SCRIPT.read_text(), re.MULTILINE)
    assert [target for target in written if target.startswith("$etc")] == []


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_bash_reads_a_script(script: Path) -> None:
    done = subprocess.run(("bash", "-n", str(script)), capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("script", PARTS, ids=lambda script: script.name)
def test_a_part_of_the_try_does_nothing_without_a_folder_of_its_own(script: Path) -> None:
    done = subprocess.run(("bash", str(script)), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode != 0
    assert re.search(r"(expected|usage).* (the folder|FOLDER)", done.stderr)
