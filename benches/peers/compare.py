#!/usr/bin/env python3
"""Compares two folders of `<stem>_dsm.npz`: largest difference over pixels that both call valid, and
how many pixels only one of them does. Exit code 1 when the difference exceeds --tolerance.

    compare.py OURS THEIRS [--tolerance 0.001]
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ours", type=Path)
    parser.add_argument("theirs", type=Path)
    parser.add_argument("--tolerance", type=float, default=0.001, help="metres")
    args = parser.parse_args()
    ours = {p.name: p for p in args.ours.rglob("*_dsm.npz")}
    theirs = {p.name: p for p in args.theirs.rglob("*_dsm.npz")}
    common = sorted(ours.keys() & theirs.keys())
    worst, worst_name, pixels, flips = 0.0, None, 0, 0
    for name in common:
        a, b = np.load(ours[name])["dsm"], np.load(theirs[name])["dsm"]
        both = ~np.isnan(a) & ~np.isnan(b)
        flips += int(np.count_nonzero(np.isnan(a) != np.isnan(b)))
        pixels += int(np.count_nonzero(both))
        if both.any():
            difference = float(np.abs(a[both].astype(np.float64) - b[both]).max())
            if difference > worst:
                worst, worst_name = difference, name
    report = {
        "images": len(common),
        "only_ours": len(ours) - len(common),
        "only_theirs": len(theirs) - len(common),
        "pixels": pixels,
        "largest_difference_m": worst,
        "where": worst_name,
        "validity_differs": flips,
    }
    json.dump(report, sys.stdout, indent=2)
    print()
    sys.exit(not common or worst > args.tolerance)


if __name__ == "__main__":
    main()
