"""The picture of the layers, from the imports in the code: `python docs/architecture.py` writes
docs/architecture.svg.

A line from one wing down to another says that the upper one imports the lower one; it is left out
where a longer way leads there, too. `_common` and `plot`, which all wings may use, stand at the
bottom without lines.
"""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests"))
from wings import layers  # noqa: E402

PACKAGE, PICTURE = ROOT / "src" / "jaxmuscle", Path(__file__).with_name("architecture.svg")
UNDRAWN = ("plot", "_common")
HOLDS = {
    "commands": "the command line",
    "paper": "the paper reproduced",
    "reports": "what results say",
    "uncertainty": "profile, posterior, what is known",
    "checks": "goodness of fit, bootstrap",
    "comparison": "which colour of noise",
    "fits": "one target, several, cohorts",
    "objective": "residuals, likelihood, descent",
    "ensembles": "many seeds, stores, sweeps",
    "explorer": "a page with sliders",
    "simulation": "solutions of the SDE",
    "response": "equilibrium, linear response",
    "data": "targets and recordings",
    "model": "muscle, noises, tasks",
    "spectra": "Welch, its law, measures",
    "plot": "all figures",
    "_common": "errors, files, text, progress",
}
WIDTH, HEIGHT, GAP, ROW, MARGIN, ROUND = 190, 54, 26, 98, 24, 10  # pixels

Place = tuple[float, float]


def imports() -> set[tuple[str, str]]:
    """Which wing imports which."""
    wings = [wing for row in layers() for wing in row]
    found = set()
    for wing in wings:
        for module in (PACKAGE / wing).glob("*.py"):
            for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
                if (
                    isinstance(node, ast.ImportFrom)
                    and (node.module or "").split(".")[0] == "jaxmuscle"
                ):
                    names = [f"{node.module}.{alias.name}".split(".")[1] for alias in node.names]
                    found |= {(wing, name) for name in names if name in wings and name != wing}
    return found


def nearest() -> list[tuple[str, str]]:
    """Which wing imports which, without those that it also reaches through another."""
    direct = {(upper, lower) for upper, lower in imports() if lower not in UNDRAWN}
    reached = set(direct)
    while more := {(a, d) for a, b in reached for c, d in direct if b == c} - reached:
        reached |= more
    between = {(a, d) for a, b in reached for c, d in reached if b == c}
    return sorted(direct - between)


def bent(*points: Place) -> str:
    """A line through these points, with round corners."""
    way = f"M{points[0][0]:.0f} {points[0][1]:.0f}"
    for (x0, y0), (x, y), (x1, y1) in zip(points, points[1:], points[2:], strict=False):
        before = x + ROUND * ((x0 > x) - (x0 < x)), y + ROUND * ((y0 > y) - (y0 < y))
        after = x + ROUND * ((x1 > x) - (x1 < x)), y + ROUND * ((y1 > y) - (y1 < y))
        way += f" L{before[0]:.0f} {before[1]:.0f} Q{x:.0f} {y:.0f} {after[0]:.0f} {after[1]:.0f}"
    return f'<path d="{way} L{points[-1][0]:.0f} {points[-1][1]:.0f}"/>'


def way(upper: Place, lower: Place, boxes: list[Place]) -> list[Place]:
    """The points of a line that leads around the boxes between: straight to the next row, else down
    beside a column."""
    (x1, y1), (x2, y2) = upper, lower
    a, b, right = x1 + WIDTH / 2, x2 + WIDTH / 2, x2 > x1

    def clear(x: float) -> bool:
        return not any(y1 < y < y2 and left < x < left + WIDTH for left, y in boxes)

    def alone(x: float, row: float, end: float) -> bool:
        return not any(
            y == row and min(x, end) < left + WIDTH / 2 < max(x, end)
            for left, y in boxes
            if left not in (x1, x2)
        )

    side1, side2 = y1 + HEIGHT / 2, y2 + HEIGHT / 2
    if round((y2 - y1) / ROW) == 1:
        return [(a, y1 + HEIGHT), (b, y2)]
    if a == b:
        gap = x1 + WIDTH + GAP / 2
        return [(x1 + WIDTH, side1), (gap, side1), (gap, side2), (x1 + WIDTH, side2)]
    if clear(b) and alone(a, y1, b):
        return [(x1 + WIDTH * right, side1), (b, side1), (b, y2)]
    if alone(a, y2, b):
        return [(a, y1 + HEIGHT), (a, side2), (x2 + WIDTH * (not right), side2)]
    end, turn = b + (-40 if right else 40), y2 - (ROW - HEIGHT) / 2
    return [(a, y1 + HEIGHT), (a, turn), (end, turn), (end, y2)]


def picture() -> str:
    """The SVG."""
    rows = layers()
    wide = max(map(len, rows)) * (WIDTH + GAP) - GAP + 2 * MARGIN
    place = {}
    for number, row in enumerate(rows):
        left = (wide - len(row) * (WIDTH + GAP) + GAP) / 2
        for i, wing in enumerate(row):
            place[wing] = left + i * (WIDTH + GAP), MARGIN + number * ROW
    lines, boxes = [], []
    for upper, lower in nearest():
        lines.append(bent(*way(place[upper], place[lower], [*place.values()])))
    for wing, (x, y) in place.items():
        boxes.append(
            f'<rect x="{x:.0f}" y="{y:.0f}" width="{WIDTH}" height="{HEIGHT}" rx="6"/>'
            f'<text x="{x + WIDTH / 2:.0f}" y="{y + 24:.0f}" class="name">{wing}</text>'
            f'<text x="{x + WIDTH / 2:.0f}" y="{y + 42:.0f}" class="holds">{HOLDS[wing]}</text>'
        )
    high = MARGIN * 2 + (len(rows) - 1) * ROW + HEIGHT
    style = (
        "rect{fill:#e8f0f8;stroke:#0072b2;stroke-width:1.2}path{fill:none;stroke:#777;stroke-width:1.5}"
        "text{font-family:sans-serif;text-anchor:middle;fill:#222}.name{font-size:15px;font-weight:bold}.holds{font-size:11px}"
    )
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {high}" width="{wide}"'
            f' height="{high}">'
        ),
        f"<style>{style}</style>",
        '<rect width="100%" height="100%" style="fill:white;stroke:none"/>',
        *lines,
        *boxes,
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
    print(f"Written: {PICTURE.relative_to(ROOT)}")
