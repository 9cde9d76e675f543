"""Make the folder of a new method from ``baselines/_template``."""

from __future__ import annotations

import colorsys
import hashlib
import shutil
from pathlib import Path

from baselines import registry
from baselines.registry import NAME, ROOT, BaselineError, bad_name, shown

TEMPLATE = ROOT / "_template"


def new_baseline(name: str, root: Path = ROOT) -> Path:
    """Copy the template to ``root/name`` with an unused colour; return the folder."""
    if not NAME.fullmatch(name):
        raise BaselineError(bad_name(name))
    folder = root / name
    if folder.exists():
        raise BaselineError(f"{shown(folder)} exists already; choose another name or remove it")
    if root != ROOT and name in registry.names(ROOT):
        raise BaselineError(f"{name!r} is a method of {shown(ROOT)}; choose another name")
    root.mkdir(parents=True, exist_ok=True)
    color = _unused_color(name, root)
    shutil.copytree(TEMPLATE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    for path in folder.iterdir():
        text = path.read_text(encoding="utf-8")
        text = text.replace("METHOD_NAME", name).replace('"#000000"', f'"{color}"')
        path.write_text(text, encoding="utf-8")
    return folder


def next_steps(name: str, root: Path = ROOT) -> str:
    """Return what a user does after `new_baseline`, one step per line."""
    folder = shown(root / name)
    return (
        f"created {folder} from the template; next:\n"
        f"  1. write the method in {folder}/adapter.py (Adapter.solve)\n"
        f"  2. fill in {folder}/card.yaml: name, summary, options and their ranges\n"
        f"  3. check it: .venv/bin/python -m baselines.check {name if root == ROOT else folder}\n"
        f"  4. compare it: make run METHODS={name},dcreg,icp"
        + ("" if root == ROOT else f" {registry.SEARCH_PATH}={shown(root)}")
    )


def _unused_color(name: str, root: Path) -> str:
    places = {ROOT, root}
    used = {
        registry.read_card(other, place).color.lower()
        for place in places
        for other in registry.names(place)
    }
    hue = int(hashlib.sha1(name.encode()).hexdigest(), 16) % 360
    while True:
        red, green, blue = colorsys.hsv_to_rgb((hue % 360) / 360, 0.65, 0.75)
        color = f"#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}"
        if color not in used:
            return color
        hue += 7
