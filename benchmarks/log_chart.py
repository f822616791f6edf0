"""A chart with logarithmic axes, as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

_WIDTH, _HEIGHT = 720, 420
_LEFT, _RIGHT, _TOP, _BOTTOM = 70, 170, 20, 50
_LINE_HEIGHT = 16
_COLORS = ("#0b5394", "#cc4125", "#6aa84f", "#8e7cc3", "#b45f06")


def write_log_chart(
    path: Path, series: dict[str, Sequence[tuple[float, float]]], *, x_title: str, y_title: str
) -> None:
    """Write lines of (x, y), both positive, over powers of ten."""
    xs = [x for line in series.values() for x, _ in line]
    ys = [y for line in series.values() for _, y in line]
    x_range, y_range = _exponents(xs), _exponents(ys)

    def place(x: float, y: float) -> tuple[float, float]:
        across = (math.log10(x) - x_range[0]) / (x_range[1] - x_range[0])
        up = (math.log10(y) - y_range[0]) / (y_range[1] - y_range[0])
        return _LEFT + across * (_WIDTH - _LEFT - _RIGHT), _HEIGHT - _BOTTOM - up * (_HEIGHT - _TOP - _BOTTOM)

    parts = []
    for power in _powers(x_range):
        x, bottom = place(10.0**power, 10.0 ** y_range[0])
        parts.append(f'<line x1="{x:.1f}" y1="{_TOP}" x2="{x:.1f}" y2="{bottom:.1f}" stroke="#ddd"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 18:.1f}" text-anchor="middle">{_number(power)}</text>')
    for power in _powers(y_range):
        left, y = place(10.0 ** x_range[0], 10.0**power)
        parts.append(f'<line x1="{left:.1f}" y1="{y:.1f}" x2="{_WIDTH - _RIGHT}" y2="{y:.1f}" stroke="#ddd"/>')
        parts.append(f'<text x="{left - 8:.1f}" y="{y + 4:.1f}" text-anchor="end">{_number(power)}</text>')
    ends = []
    for (name, line), color in zip(series.items(), _COLORS, strict=False):
        if not line:
            continue
        places = [place(x, y) for x, y in line]
        corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polyline points="{corners}" fill="none" stroke="{color}" stroke-width="2"/>')
        parts.extend(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{color}"/>' for x, y in places)
        ends.append((*places[-1], name, color))
    before = lowest = -math.inf
    for x, y, name, color in sorted(ends):
        # Names of lines that end together stand one below the other.
        lowest = max(y + 4, lowest + _LINE_HEIGHT) if x - before < 1 else y + 4
        before = x
        parts.append(f'<text x="{x + 8:.1f}" y="{lowest:.1f}" fill="{color}">{escape(name)}</text>')
    middle_x, middle_y = (_LEFT + _WIDTH - _RIGHT) / 2, (_TOP + _HEIGHT - _BOTTOM) / 2
    parts.append(f'<text x="{middle_x}" y="{_HEIGHT - 10}" text-anchor="middle">{escape(x_title)}</text>')
    parts.append(
        f'<text transform="translate(16 {middle_y}) rotate(-90)" text-anchor="middle">{escape(y_title)}</text>'
    )
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-family="sans-serif"'
        f' font-size="13">\n<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n",
        encoding="utf-8",
    )


def _exponents(values: Sequence[float]) -> tuple[float, float]:
    """Logarithms of a range around all values."""
    return math.log10(min(values)) - 0.15, math.log10(max(values)) + 0.15


def _powers(exponents: tuple[float, float]) -> range:
    """Whole exponents in a range."""
    return range(math.ceil(exponents[0]), math.floor(exponents[1]) + 1)


def _number(power: int) -> str:
    return f"{10**power:,}" if power >= 0 else f"{10.0**power:g}"
