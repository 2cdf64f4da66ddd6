"""The table of alerts, from the rules for Prometheus."""

from __future__ import annotations

from pathlib import Path

import yaml

from docs.generate.declared import table

RULES = Path(__file__).parents[2] / "deploy" / "prometheus" / "alerts.yml"


def sections() -> dict[str, str]:
    """Write a row for each alert."""
    (group,) = yaml.safe_load(RULES.read_text())["groups"]
    rows = [
        (
            f"`{rule['alert']}`",
            rule["labels"]["severity"],
            rule.get("for", "at once"),
            rule["annotations"]["description"],
        )
        for rule in group["rules"]
    ]
    return {"alerts": table(("alert", "severity", "after", "what it means, and what to do"), rows)}
