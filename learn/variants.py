"""Variants of a configuration file of ``configs/models/``: changes by name, so that an ablation is one file.

No torch: the workflow reads them too.
"""

from __future__ import annotations

from sim.errors import InputError


def with_variant(content: dict, variant: str | None, where: object) -> dict:
    """A configuration file's content as one of its ``variants`` changes it (None: as it stands). Raises ``InputError`` on an unknown one."""
    variants = content.get("variants") or {}
    content = {key: value for key, value in content.items() if key != "variants"}
    if not isinstance(variants, dict) or not all(isinstance(change, dict) for change in variants.values()):
        raise InputError(where, "variants", type(variants).__name__, "must map names to changes of settings, training and data")
    if variant is None:
        return content
    if variant not in variants:
        raise InputError(where, "variant", variant, f"not among the variants {', '.join(sorted(map(str, variants))) or '(there are none)'}")
    for key, change in variants[variant].items():
        both = isinstance(change, dict) and isinstance(content.get(key, {}), dict)
        content[key] = content.get(key, {}) | change if both else change
    return content
