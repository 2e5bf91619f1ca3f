"""Line plots as SVG."""

from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 640, 420
LEFT, RIGHT, TOP, BOTTOM = 70, 220, 20, 55
COLOURS = ["#888", "#06c", "#0a0", "#a0a", "#fc0", "#c60", "#c00", "#0cc", "#088", "#000"]


@dataclass
class Line:
    """Points (x, y) in the units of the axes, either joined by a line or drawn as marks."""

    name: str
    colour: str
    points: list
    is_dashed: bool = False
    is_marked: bool = False


def colour_of(index):
    """A different colour for each index: first those of the list, then hues that are a golden angle apart."""
    if index < len(COLOURS):
        return COLOURS[index]
    return f"hsl({137.508 * index % 360:.1f},60%,35%)"


def svg(x_name, y_name, x_max, y_max, step, lines):
    """Draws lines; both axes start at 0 and have a tick at each step."""

    def x_of(x):
        return LEFT + x / x_max * (WIDTH - LEFT - RIGHT)

    def y_of(y):
        return HEIGHT - BOTTOM - y / y_max * (HEIGHT - TOP - BOTTOM)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="13">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
    ]
    for x in range(0, x_max + 1, step):
        parts.append(stroke([(x_of(x), y_of(0)), (x_of(x), y_of(y_max))], "#ddd"))
        parts.append(f'<text x="{x_of(x):.1f}" y="{y_of(0) + 18:.1f}" text-anchor="middle">{x}</text>')
    for y in range(0, y_max + 1, step):
        parts.append(stroke([(x_of(0), y_of(y)), (x_of(x_max), y_of(y))], "#ddd"))
        parts.append(f'<text x="{x_of(0) - 8:.1f}" y="{y_of(y) + 4:.1f}" text-anchor="end">{y}</text>')
    middle = (x_of(0) + x_of(x_max)) / 2
    parts.append(f'<text x="{middle:.1f}" y="{HEIGHT - 14}" text-anchor="middle">{escape(x_name)}</text>')
    turned = f"translate(24 {(y_of(0) + y_of(y_max)) / 2:.1f}) rotate(-90)"
    parts.append(f'<text transform="{turned}" text-anchor="middle">{escape(y_name)}</text>')
    for index, line in enumerate(lines):
        points = [(x_of(x), y_of(y)) for x, y in line.points]
        y = TOP + 12 + 24 * index
        sample = [(WIDTH - RIGHT + 16, y), (WIDTH - RIGHT + 44, y)]
        parts += drawn(line, points) + drawn(line, sample)
        parts.append(f'<text x="{WIDTH - RIGHT + 52}" y="{y + 4}">{escape(line.name)}</text>')
    return "\n".join([*parts, "</svg>\n"])


def drawn(line, points):
    """Draws a line and its marks."""
    marks = [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{line.colour}"/>' for x, y in points if line.is_marked]
    return [stroke(points, line.colour, 2, line.is_dashed), *marks]


def stroke(points, colour, width=1, is_dashed=False):
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dashes = ' stroke-dasharray="6 5"' if is_dashed else ""
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width}"{dashes}/>'
