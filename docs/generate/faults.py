"""The tables of faults, from their declaration."""

from __future__ import annotations

from docs.generate.declared import members, table
from zbridge.control.faults import EVENTS, INCIDENTS, FaultCode


def sections() -> dict[str, str]:
    """Return the table of all faults, and that of the causes that the black box knows."""
    texts = {code: text.rstrip(".") for code, text in members(FaultCode)}
    rows = [
        (f"`{code}`", text, "event" if code in EVENTS else "lasting", "yes" if code in INCIDENTS else "-")
        for code, text in texts.items()
    ]
    causes = [(f"`{code}`", text) for code, text in texts.items() if code in INCIDENTS]
    causes.append(("`mark`", "Somebody asked for it: `zbridge mark --keep`"))
    return {
        "faults": table(("code", "meaning", "kind", "incident"), rows),
        "faults: incidents": table(("code", "cause"), causes),
    }
