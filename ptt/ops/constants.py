"""The numbers that plain functions and kernels in C++ share; the build writes them into the header `constants.h`.

A number that comes from a trial says which; the others follow from a format or from a paper.
"""

from __future__ import annotations

HARMONICS = 16
"""Functions of the hemisphere in which indirect light arrives: those of order 4 (Sun et al. 2007, section 3.1)."""

MOST_LOBES = 4
"""Lobes of a BRDF tensor: a word of fractional visibility holds a byte for each."""

MOST_CELLS = 64
"""Lobes of a material whose f is cut to cells, in the kernel."""

TILTS = 48
"""Cosines of wo at which such lobes are tabulated."""

RINGS = 136
"""Rings about the normal, of half vectors for which f is sampled: four for twice the squared slope."""

SECTORS = 16
"""Sectors of half a ring."""

SHARPEST = -24
"""A power of two, about the square of the smallest slope that f is sampled for: that of GGX of roughness 0.015."""

HEAD_ON = 1e-4
"""The sine of the angle to the normal from which a direction has an azimuth: float32 knows it to 1e-3 there."""

LEVELS = 10
"""Widths of lobes that light is blurred to, each the root of two times the one before; the last covers 56 degrees."""

BITS = 64
"""Cells along the edge of the map of bits of what a point sees."""

WIDE_SIDE = 16
"""Cells along the edge of the map of what a point sees of lobes of 14 degrees, a byte each."""

WIDEST_SIDE = 8
"""The same for lobes of 28 degrees."""

LEAST_SHARE = 0.05
"""Of a lobe, the smallest part that has a mean direction of its own: what maps of bytes know of less is noise."""

FURTHEST = 1.5
"""Standard deviations of a lobe between its axis and the mean direction of a part of it, at most."""

MEETS = 24
"""Cells along the edge of the map of which points a point sees."""

MET = MEETS * MEETS * 3 // 2
"""Words of such a map: of each two cells the points, and then the normals there."""

NORMAL = 127
"""The number that stands for 1 in the signed bytes of a normal."""

NOTHING = -128
"""What stands in these bytes where nothing is met."""

EDGE = 0.95
"""The cosine of 18 degrees, the angle between normals of neighbouring cells from which an edge lies between them: in a
trial on an engine 11 to 60 degrees served alike, with 25.5 to 27 % of error where no edges left 39.4."""

SPREAD = 9.5
"""The level that a lobe as wide as all of a material together would have, 66 degrees, from which what they see of
surfaces goes over to the mean of all that a point sees, within one level."""

PARTS = 4
"""Lobes by which what a point sees of others reflects, where much of what the point reflects comes from there."""

CLOSE = 0.05
"""What a lobe of 16 of a point reflects of a surface from which that reflects by `PARTS` lobes in place of one, and by
them alone from twice as much: in a trial on a statue of gold of roughness 0.2, those lobes were 3.7 of 11.8 that saw
surfaces, and served as well as all."""

RECORD = 16
"""Numbers of a point as others see it: they fill a cache line, of which 11 are used."""

SENT = 12
"""Numbers that say what a point sends to others, of which 9 are used."""

ROW = 8
"""Numbers of a row of a table of lobes by which points reflect to others, of which 7 are used."""

TILE = 4
"""Cells along the edge of a tile of fractional visibility: 16 words of 4 bytes fill a cache line of 64."""

GROUP = 16
"""Points, cells and terms are padded to multiples of it: floats in the widest vector, that of AVX-512."""

WIDTH = 64
"""Points in a block of `expand` come in multiples of it: four vectors of 16, the tile whose sums stay in registers."""

ROOTS = 20
"""Triangles of an icosahedron, roots of the geodesic trees (Ma et al. 2006, section 3.1)."""

CORNERS = 4
"""Cells around a point of a bilinear lookup."""

CHANNELS = 4
"""Channels of a local light: three colours and a zero, which aligns them to 16 bytes."""

BYTE = 255
"""The largest number of a byte: visibility of 1."""

SUMMED_IN_HALVES = 320
"""Triangles whose products are summed in float16 before the sum is widened to float32. A trial at 1280 triangles:
longer runs are no faster; each of ten roundings errs by 2^-11 at most."""

LARGEST_WORD = 32767
"""The largest number that `expand` writes to int16, of the largest sum of a row."""

TINY = 1e-30
"""What a divisor is at least: far below any light, far above the smallest float32."""

LINE = 64
"""Bytes that memory gives at a time, a cache line."""
