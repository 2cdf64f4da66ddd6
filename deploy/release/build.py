"""Builds wheel and sdist from an export of the work tree, and checks them.

Usage: python deploy/release/build.py [FOLDER]. Needs git, and hatchling, which tools.txt pins.

Everything is built twice, in different folders, with one SOURCE_DATE_EPOCH (the time of the last commit, unless it is
set), and a third wheel is built from the sdist. The sdists must have the same bytes, and so must the wheels. The wheel
holds the packages as git tracks them, LICENSE and SBOM; the sdist holds all that git tracks.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("zbridge/", "gateways/")
METADATA = ("METADATA", "RECORD", "WHEEL", "entry_points.txt", "licenses/LICENSE", "sboms/zbridge.cdx.json")


class Unsound(Exception):
    """What was built is not what should be released."""


def git(*arguments: str) -> str:
    return subprocess.run(["git", "-C", str(ROOT), *arguments], check=True, capture_output=True, text=True).stdout


def tracked() -> list[str]:
    """List the files of the work tree: those that git tracks or would add."""
    found = git("ls-files", "-z", "--cached", "--others", "--exclude-standard").split("\0")
    return sorted(name for name in found if name and (ROOT / name).is_file())


def export(files: Iterable[str], folder: Path) -> Path:
    """Copy files of the work tree; they get new times."""
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / name)
        (folder / name).chmod((ROOT / name).stat().st_mode)
    return folder


def build(source: Path, kind: str, epoch: str) -> Path:
    """Build a wheel or an sdist of a folder with the installed hatchling."""
    output = source / "dist"
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(output)]
    done = subprocess.run(
        command,
        cwd=source,
        check=False,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "SOURCE_DATE_EPOCH": epoch},
    )
    if done.returncode != 0:
        raise Unsound(f"{' '.join(command)}:\n{done.stdout}")
    (built,) = output.glob("*.whl" if kind == "wheel" else "*.tar.gz")
    return built


def unpack(sdist: Path, folder: Path) -> Path:
    """Unpack an sdist; return its only folder."""
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (source,) = folder.iterdir()
    return source


def require_same(paths: Iterable[Path]) -> None:
    """Raise Unsound if files differ."""
    first, *others = paths
    for other in others:
        if other.read_bytes() != first.read_bytes():
            raise Unsound(f"{first} and {other} differ: the build is not reproducible")


def require_content(archive: str, found: Iterable[str], expected: Iterable[str]) -> None:
    """Raise Unsound if an archive lacks files, or has others."""
    has, needs = set(found), set(expected)
    faults = [*(f"+ {name}" for name in sorted(has - needs)), *(f"- {name}" for name in sorted(needs - has))]
    if faults:
        raise Unsound("\n".join([f"{archive}: files that do not belong there (+) or are missing (-):", *faults]))


def check_content(wheel: Path, sdist: Path, files: list[str]) -> None:
    """Raise Unsound unless wheel and sdist hold exactly what they should."""
    information = "-".join(wheel.name.split("-")[:2]) + ".dist-info"
    packed = [name for name in files if name.startswith(PACKAGES)]
    expected = [*packed, *(f"{information}/{name}" for name in METADATA)]
    require_content(wheel.name, zipfile.ZipFile(wheel).namelist(), expected)
    with tarfile.open(sdist) as archive:
        members = [each.name.partition("/")[2] for each in archive.getmembers() if each.isfile()]
    require_content(sdist.name, members, [*files, "PKG-INFO"])


def main(folder: Path) -> None:
    """Build, compare, check, and leave wheel and sdist in a folder."""
    files, epoch = tracked(), os.environ.get("SOURCE_DATE_EPOCH") or git("log", "-1", "--format=%ct").strip()
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        sources = [export(files, work / name) for name in ("one", "two")]
        sdists = [build(source, "sdist", epoch) for source in sources]
        wheels = [build(source, "wheel", epoch) for source in sources]
        wheels.append(build(unpack(sdists[0], work / "three"), "wheel", epoch))
        require_same(sdists)
        require_same(wheels)
        check_content(wheels[0], sdists[0], files)
        folder.mkdir(parents=True, exist_ok=True)
        for built in (sdists[0], wheels[0]):
            print(shutil.copy(built, folder), flush=True)


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1] if len(sys.argv) > 1 else "dist"))
    except Unsound as fault:
        sys.exit(str(fault))
