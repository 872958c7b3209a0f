#!/usr/bin/env python3
"""Averaged densities against averaged DSMs where windows disagree, on closed-form columns; prints Markdown.

    python benches/studies/tile_blend.py

A column is solid (one density) up to its surface. Levels are 2/320 of a cube unit apart, light comes from above, a cell
is piecewise constant, and the height is the expected height at which light ends, divided by opacity: the rule of
`sat3d tile`. A cell that the surface cuts has the density times its filled share. Needs NumPy.
"""
import numpy as np

LEVELS = 320
METRES_PER_UNIT = 32.24  # 64.48 m for the cube, the published scale
CELL = 2 / LEVELS
BOTTOMS_M = np.arange(LEVELS) * CELL * METRES_PER_UNIT
CELL_M = CELL * METRES_PER_UNIT
GROUND_M, ROOF_M = 4.0, 14.0
DENSITIES = (10, 30, 100, 400)


def column(surface_m, density):
    """Densities per cube unit, from the lowest level."""
    return density * np.clip((surface_m - BOTTOMS_M) / CELL_M, 0, 1)


def height(densities):
    """Expected height at which light from above ends, metres; exact for piecewise constant cells."""
    depth = densities[::-1] * CELL
    before = np.concatenate([[0], np.cumsum(depth)[:-1]])
    share = np.exp(-before) * -np.expm1(-depth)
    thin = depth < 1e-4
    safe = np.where(thin, 1, depth)
    into = np.where(thin, 0.5 - depth / 12, 1 / safe - 1 / np.expm1(np.minimum(safe, 700)))
    tops = (BOTTOMS_M + CELL_M)[::-1]
    return float(np.sum(share * (tops - into * CELL_M)) / np.sum(share))


def check():
    """The sum over cells against the closed form of a solid: the surface less one mean free path."""
    for density in (30, 100, 400):
        surface = 199 * CELL_M
        depth = density * surface / METRES_PER_UNIT
        free = METRES_PER_UNIT / density
        expected = surface - free + surface * np.exp(-depth) / -np.expm1(-depth)
        assert abs(height(column(surface, density)) - expected) < 1e-9, density


def both(surfaces, shares, density):
    """Height of the averaged densities, and the average of the heights."""
    columns = [column(surface, density) for surface in surfaces]
    averaged = height(sum(share * one for share, one in zip(shares, columns)))
    return averaged, sum(share * height(one) for share, one in zip(shares, columns))


def table(title, head, rows):
    print(f"\n{title}\n\n| {' | '.join(head)} |\n|{'|'.join(['---:'] * len(head))}|")
    for row in rows:
        print("| " + " | ".join(v if isinstance(v, str) else f"{v:.2f}" for v in row) + " |")


def two_windows():
    cases = {
        "wall, one pixel apart": (ROOF_M, GROUND_M),
        "roof, 1 m apart": (ROOF_M + 1, ROOF_M),
    }
    head = ["density", "window A", "window B", "averaged density", "averaged DSM"]
    for title, (a, b) in cases.items():
        rows = []
        for density in DENSITIES:
            alone = [height(column(one, density)) for one in (a, b)]
            rows.append([str(density), *alone, *both((a, b), (0.5, 0.5), density)])
        table(f"{title} ({a:g} m and {b:g} m), two windows, m", head, rows)


def wall():
    """Heights across a wall that A puts at pixel 4 and B at pixel 5 (0.25 m each)."""
    rows = []
    for density in (30, 100):
        profiles = [], []
        for pixel in range(2, 8):
            surfaces = [ROOF_M if pixel >= edge else GROUND_M for edge in (4, 5)]
            for profile, value in zip(profiles, both(surfaces, (0.5, 0.5), density)):
                profile.append(value)
        for name, profile in zip(("averaged density", "averaged DSM"), profiles):
            rows.append([f"{name}, {density}", *profile])
    table("Across the wall, pixels 2 to 7, m", ["", *map(str, range(2, 8))], rows)


def shares():
    """What k of n windows see."""
    votes = [(1, 16), (1, 4), (1, 2), (3, 4), (1, 1)]
    head = ["", *(f"{k} of {n}" for k, n in votes)]
    for title, high, low in (("building of 10 m", ROOF_M, GROUND_M), ("roof 1 m higher", ROOF_M + 1, ROOF_M)):
        rows = []
        for density in DENSITIES:
            base = height(column(low, density))
            part = [both((high, low), (k / n, 1 - k / n), density)[0] - base for k, n in votes]
            rows.append([f"averaged density, {density}", *part])
        base = height(column(low, 100))
        part = [both((high, low), (k / n, 1 - k / n), 100)[1] - base for k, n in votes]
        rows.append(["averaged DSM", *part])
        table(f"{title}, seen by k of n windows: height above what the others see, m", head, rows)


check()
two_windows()
wall()
shares()
