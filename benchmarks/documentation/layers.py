"""The picture of the layers: folders of the code and their imports, read from the code."""

import ast
import graphlib
from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

ROOT = Path(__file__).parents[2]
PACKAGES = {
    "pixcal": ROOT / "pipeline/pixcal",
    "blind_examination": ROOT / "bench/blind_examination",
    "pixcal_cli": ROOT / "cli/pixcal_cli",
}
Graph = dict[str, set[str]]

BOX, GAP, RISE, EDGE = (132, 40), 36, 84, 24
"""Width and height of a box, room between boxes and between rows of them, margin, px."""
STYLE = """
  svg { color-scheme: light dark; font: 15px sans-serif }
  rect { fill: #eef2f7; stroke: #51647d; stroke-width: 1.2 }
  text { fill: #1d2733; text-anchor: middle; dominant-baseline: central }
  path { fill: none; stroke: #51647d; stroke-width: 1.3; marker-end: url(#head) }
"""


def imports_of_folders() -> Graph:
    """Folder -> the folders of the project that its modules import."""
    graph: Graph = {}
    for package, folder in PACKAGES.items():
        for file in folder.rglob("*.py"):
            own = _folder([package, *file.relative_to(folder).parts[:-1]])
            if own:
                graph.setdefault(own, set()).update(set(_imported(file)) - {own})
    return graph


def _folder(parts: list[str]) -> str:
    return parts[0] if parts[0] != "pixcal" else parts[1] if len(parts) > 1 else ""


def _imported(file: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [name.name for name in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{name.name}" for name in node.names]
        for name in names:
            parts = name.split(".")
            folder = _folder(parts) if parts[0] in PACKAGES else ""
            # A name of `pixcal` itself is no folder.
            if folder in PACKAGES or (folder and (PACKAGES["pixcal"] / folder).is_dir()):
                yield folder


def reduced(graph: Graph) -> Graph:
    """The graph without the edges that follow from others."""

    def below(folder: str) -> set[str]:
        return graph[folder].union(*(below(other) for other in graph[folder]))

    return {
        folder: direct - set().union(*(below(other) for other in direct))
        for folder, direct in graph.items()
    }


def rows_of(graph: Graph) -> list[list[str]]:
    """Folders from the highest row to the lowest; each stands just below those that import it."""
    importers: Graph = {folder: set() for folder in graph}
    for folder, others in graph.items():
        for other in others:
            importers[other].add(folder)
    depth: dict[str, int] = {}
    for folder in graphlib.TopologicalSorter(importers).static_order():
        depth[folder] = 1 + max((depth[other] for other in importers[folder]), default=-1)
    rows: list[list[str]] = [[] for _ in range(max(depth.values()) + 1)]
    for folder in sorted(depth):
        rows[depth[folder]].append(folder)
    return rows


def places_of(graph: Graph) -> dict[str, tuple[float, float]]:
    """Middle of each box: below the middle of those that import it, where there is room."""
    places: dict[str, tuple[float, float]] = {}
    for level, row in enumerate(rows_of(graph)):
        above = {
            folder: [places[other][0] for other in places if folder in graph[other]]
            for folder in row
        }
        wanted = [sum(xs) / len(xs) if xs else 0.0 for xs in above.values()]
        centre = sum(wanted) / len(wanted)
        for number, folder in enumerate(row):
            x = centre + (number - (len(row) - 1) / 2) * (BOX[0] + GAP)
            places[folder] = x, EDGE + BOX[1] / 2 + level * RISE
    left = min(x for x, _ in places.values()) - BOX[0] / 2 - EDGE
    return {folder: (x - left, y) for folder, (x, y) in places.items()}


def picture() -> str:
    """The picture as SVG; each arrow is a path with ``data-from`` and ``data-to``."""
    graph = reduced(imports_of_folders())
    places = places_of(graph)
    width = max(x for x, _ in places.values()) + BOX[0] / 2 + EDGE
    height = max(y for _, y in places.values()) + BOX[1] / 2 + EDGE
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width:g}" height="{height:g}" role="img">',
        "<title>Who imports whom</title>",
        f"<style>{STYLE}</style>",
        '<marker id="head" markerWidth="9" markerHeight="8" refX="8" refY="4" orient="auto">'
        '<polygon points="0 0, 9 4, 0 8" fill="#51647d"/></marker>',
    ]
    for folder, others in sorted(graph.items()):
        lines += [_arrow(folder, other, places) for other in sorted(others)]
    lines += [_box(folder, *place) for folder, place in sorted(places.items())]
    return "\n".join([*lines, "</svg>", ""])


def _arrow(folder: str, other: str, places: dict[str, tuple[float, float]]) -> str:
    (x0, y0), (x1, y1) = places[folder], places[other]
    y0, y1, bend = y0 + BOX[1] / 2, y1 - BOX[1] / 2, (RISE - BOX[1]) / 2
    turn = y1 - 2 * bend
    curve = f"M {x0:g} {y0:g} V {turn:g} C {x0:g} {turn + bend:g} {x1:g} {turn + bend:g}"
    ends = f"data-from={quoteattr(folder)} data-to={quoteattr(other)}"
    return f'<path {ends} d="{curve} {x1:g} {y1:g}"/>'


def _box(folder: str, x: float, y: float) -> str:
    left, top = x - BOX[0] / 2, y - BOX[1] / 2
    return (
        f'<rect x="{left:g}" y="{top:g}" width="{BOX[0]}" height="{BOX[1]}" rx="6"/>'
        f'<text x="{x:g}" y="{y:g}">{folder}</text>'
    )
