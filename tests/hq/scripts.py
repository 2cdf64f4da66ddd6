"""Scenes written as text: a title, in brackets what is special, and, indented, the steps one after the other."""

from __future__ import annotations

import re

import pytest

_REPEATED = re.compile(r"(\d+) x ([(\[])(.*?)[)\]]")


def scripts(text: str) -> pytest.MarkDecorator:
    """Parametrise a test with what is ``special`` of each scene, and its ``script``: steps separated by semicolons.

    ``3 x (at 1; wait 0.1)`` are three times these steps, ``3 x [stop]`` is a list, ``stop, stop, stop``.
    """
    title, steps = "", dict[str, list[str]]()
    for line in text.strip().splitlines():
        if line.startswith("    "):
            steps[title].append(line.strip())
        elif not line.startswith("#"):
            title = line
            steps[title] = []
    rows = []
    for title, lines in steps.items():
        name, _, special = title.removesuffix("]").partition(" [")
        script = _REPEATED.sub(_repeat, "; ".join(lines))
        rows.append(pytest.param(special, script, id=name))
    return pytest.mark.parametrize(("special", "script"), rows)


def _repeat(found: re.Match[str]) -> str:
    times, bracket, what = found.groups()
    return {"(": "; ", "[": ", "}[bracket].join([what] * int(times))
