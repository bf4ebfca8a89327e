"""Draws the rooms of both packages and the imports between them, as they are: run by the build of the documentation."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import grimp
import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).resolve().parent.parent

EDGE = 0.5
"""Half the width of a box."""


def rungs() -> dict[str, list[str]]:
    """The rooms of each package from top to bottom, as the import contract has them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    return {
        container: [rung for rung in contract["layers"] if not rung.startswith("_") and "|" not in rung]
        for contract in contracts
        if contract["type"] == "layers"
        for container in contract.get("containers", [])
    }


def lines(package: str, room: str) -> int:
    """Of code, comments and docstrings in a room."""
    place = ROOT / package / room
    files = place.rglob("*.py") if place.is_dir() else [place.with_suffix(".py")]
    return sum(len(file.read_text().splitlines()) for file in files)


def draw(path: Path) -> None:
    """One column a package: a box for each room, an arrow for the modules of one room that import another."""
    sys.path.insert(0, str(ROOT))
    graph = grimp.build_graph("liethermo", "manifolds", cache_dir=None)
    columns = rungs()
    figure, ax = plt.subplots(figsize=(9, 7))
    places: dict[str, tuple[float, float]] = {}
    for column, (package, rooms) in enumerate(columns.items()):
        x = 4.0 * column
        ax.text(x, 0.9, package, ha="center", weight="bold")
        for row, room in enumerate(rooms):
            name, y = f"{package}.{room}", -float(row)
            places[name] = (x, y)
            box = FancyBboxPatch((x - EDGE, y - 0.34), 2 * EDGE, 0.68, "round,pad=0,rounding_size=0.08", fc="#eef3f8")
            ax.add_patch(box)
            ax.text(x, y, f"{room}\n{lines(package, room)} lines", ha="center", va="center", size=8)
    for above, (x, y) in places.items():
        for below, (u, v) in places.items():
            if above == below or (x == u and v > y) or below.endswith(".errors"):  # every room raises errors
                continue
            count = sum(
                imported == below or imported.startswith(f"{below}.")
                for module in [above, *graph.find_descendants(above)]
                for imported in graph.find_modules_directly_imported_by(module)
            )
            if count:
                inside = x == u
                start, end = (x + EDGE, y), (u + EDGE if inside else u - EDGE, v)
                bend = -0.35 if inside else 0.0
                style = {"arrowstyle": "-|>", "connectionstyle": f"arc3,rad={bend}", "color": "#3b6ea5", "alpha": 0.5}
                style |= {"linewidth": 0.4 + 0.12 * min(count, 12), "shrinkA": 0, "shrinkB": 0}
                ax.annotate("", end, start, arrowprops=style)
    ax.set_xlim(-0.8, 6.0)
    ax.set_ylim(-max(map(len, columns.values())), 1.3)
    ax.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, bbox_inches="tight")
    plt.close(figure)


if __name__ == "__main__":
    draw(ROOT / "docs" / "generated" / "rooms.svg")
