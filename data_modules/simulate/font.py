"""Capital letters and digits as strokes on a lattice of 4 by 6.

A glyph is a list of lines, each a list of lattice points XY (X to the right 0 … 4, Y up 0 … 6).
"""

from __future__ import annotations

import numpy as np

from nlos_lit.capture.errors import UserError

WIDTH, HEIGHT = 4, 6  # of a glyph, in lattice steps
GLYPHS = {
    "A": "00 04 26 44 40|02 42",
    "B": "03 06 36 45 44 33 03 00 30 41 42 33",
    "C": "45 36 16 05 01 10 30 41",
    "D": "00 06 26 44 42 20 00",
    "E": "46 06 00 40|03 33",
    "F": "46 06 00|03 33",
    "G": "45 36 16 05 01 10 30 41 43 23",
    "H": "00 06|40 46|03 43",
    "I": "10 30|16 36|20 26",
    "J": "46 41 30 10 01",
    "K": "00 06|46 03 40",
    "L": "06 00 40",
    "M": "00 06 23 46 40",
    "N": "00 06 40 46",
    "O": "10 01 05 16 36 45 41 30 10",
    "P": "00 06 36 45 44 33 03",
    "Q": "10 01 05 16 36 45 41 30 10|22 40",
    "R": "00 06 36 45 44 33 03|23 40",
    "S": "45 36 16 05 04 13 33 42 41 30 10 01",
    "T": "06 46|26 20",
    "U": "06 01 10 30 41 46",
    "V": "06 20 46",
    "W": "06 10 24 30 46",
    "X": "06 40|00 46",
    "Y": "06 23 46|23 20",
    "Z": "06 46 00 40",
    "0": "10 01 05 16 36 45 41 30 10|12 34",
    "1": "15 26 20|10 30",
    "2": "05 16 36 45 44 00 40",
    "3": "05 16 36 45 44 33 42 41 30 10 01|13 33",
    "4": "30 36 02 42",
    "5": "46 06 03 33 42 41 30 10 01",
    "6": "45 36 16 05 01 10 30 41 42 33 03",
    "7": "06 46 10",
    "8": "13 04 05 16 36 45 44 33 13 02 01 10 30 41 42 33",
    "9": "01 10 30 41 45 36 16 05 04 13 43",
    "-": "13 33",
    "+": "13 33|22 24",
    ".": "20",
    " ": "",
}


def lines(text: str, size: float, gap: float) -> list[np.ndarray]:
    """A word as lines to draw, in the plane of the paper.

    Args:
        text: capital letters, digits, ``-``, ``+``, full stops and blanks.
        size: height of a capital, m; it is two thirds as wide.
        gap: between letters, m.

    Returns:
        polylines ``[N, 2]`` of (right, up), m, around the middle of the word.

    Raises:
        UserError: a letter that has no strokes, or nothing to draw.

    Examples:
        >>> [line.round(9).tolist() for line in lines("L", size=0.6, gap=0.1)]
        [[[-0.2, 0.3], [-0.2, -0.3], [0.2, -0.3]]]
    """
    unknown = sorted(set(text) - set(GLYPHS))
    if unknown or not text.strip():
        raise UserError(
            f"text={text!r} cannot be drawn{': no strokes for ' + ' '.join(unknown) if unknown else ''}; "
            f"the letters are {''.join(GLYPHS).strip()} and blanks"
        )
    step = size / HEIGHT
    advance = WIDTH * step + gap
    middle = np.array([len(text) * advance - gap, size]) / 2
    drawn = []
    for i, letter in enumerate(text):
        for line in filter(None, GLYPHS[letter].split("|")):
            points = np.array([[int(point[0]), int(point[1])] for point in line.split()], dtype=np.float64)
            drawn.append(points * step + [i * advance, 0.0] - middle)
    return drawn
