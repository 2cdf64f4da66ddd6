"""``python -m docs.generate``: writes the generated parts of all pages; ``--check``: only tells what is out of date."""

from __future__ import annotations

import re
import sys
from functools import cache
from pathlib import Path

from docs.generate import alerts, bus, command_line, configuration, events, faults, metrics

DOCS = Path(__file__).parents[1]
PART = re.compile(r"(<!-- generated: ([^>]+) -->\n).*?(<!-- /generated -->)", re.DOTALL)


@cache
def generated() -> dict[str, str]:
    """Return every generated part by its name."""
    parts = (alerts, bus, configuration, command_line, events, faults, metrics)
    return {name: text for part in parts for name, text in part.sections().items()}


def rewritten(page: str, parts: dict[str, str]) -> str:
    """Return a page with its generated parts as the code has them now; KeyError for an unknown part."""
    return PART.sub(lambda part: f"{part[1]}\n{parts[part[2]].strip()}\n\n{part[3]}", page)


def main() -> None:
    parts, stale = generated(), []
    for page in sorted(DOCS.rglob("*.md")):
        text = page.read_text()
        new = rewritten(text, parts)
        if new != text:
            stale.append(str(page.relative_to(DOCS)))
            if "--check" not in sys.argv:
                page.write_text(new)
    sys.stdout.write("".join(f"{name}\n" for name in stale))
    sys.exit("--check" in sys.argv and bool(stale))


if __name__ == "__main__":
    main()
