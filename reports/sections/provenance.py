"""Versions, machine, commit, configuration, command lines and method cards."""

from __future__ import annotations

from typing import Any

import yaml

from reports.page import Page

ID = "provenance"
TITLE = "Provenance"
POSITION = 100

_LONG = ("config", "methods", "versions")


def context(page: Page) -> dict[str, Any]:
    facts = page.tables.provenance
    return {
        "facts": {key: value for key, value in facts.items() if key not in _LONG},
        "versions": facts.get("versions", {}),
        "config": yaml.safe_dump(facts["config"], sort_keys=False, allow_unicode=True)
        if facts.get("config")
        else "",
        "cards": {method: page.tables.cards.get(method, {}) for method in page.tables.methods},
    }
