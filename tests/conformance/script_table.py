"""Tables of conversations with a judge: a line is a name, the judge it is about, and a script (see ``scene``)."""

import re
from typing import Any

import pytest

from tests.conformance.scene import scripts


def table(lines: str, judges: dict[str, dict[str, Any]]) -> pytest.MarkDecorator:
    """Parametrise a test over ``options`` and ``steps``.

    ``"a late probe | udp | probing; by_udp PROBE; ! too late"``; ``judges`` are the options by name. What is
    indented more goes on with the line before.
    """
    found = {}
    for line in re.sub(r"\n {8,}", " ", lines).strip().splitlines():
        name, judge, script = (part.strip() for part in line.split(" | "))
        assert name not in found, name
        found[name] = (judges[judge], re.split(r"\s*;\s*", script))
    return scripts(found)
