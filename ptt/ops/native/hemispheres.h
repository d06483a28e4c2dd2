// What points see of their hemispheres (ptt/ops/hemispheres.py): bits of the cells of a map, then bytes of two more.

#pragma once
#include "lanes.h"

// Where the bytes of a point lie, for a map of bits with so many cells along an edge.
struct Layout {
    int bits, wide, widest, all;
    explicit Layout(int side)
        : bits(side), wide(side * side / 8), widest(wide + WIDE_SIDE * WIDE_SIDE),
          all(widest + WIDEST_SIDE * WIDEST_SIDE) {}
};

// ptt.ops.octahedral.hemi_octahedral
static inline void hemi_octahedral(const Lanes *d, Lanes &a, Lanes &b) {
    const Lanes scale = 1.0f / most(size(d[0]) + size(d[1]) + size(d[2]), all(TINY));
    a = (d[0] + d[1]) * scale, b = (d[0] - d[1]) * scale;
}

// ptt.ops.hemispheres.bits_at, of points of which what is seen begins at some bytes
static inline Lanes bits_at(const uint8_t *seen, int side, Ints from, Lanes a, Lanes b) {
    const Place p = place(a, b, side);
    const Ints byte = clamp(p.column >> 3, side / 8 - 4), shift = p.column - 8 * byte;  // 32 bits with both columns
    const Ints first = from + p.row * (side / 8) + byte;
    const Ints above = gather_bytes(seen, first) >> shift, below = gather_bytes(seen, first + side / 8) >> shift;
    const Lanes bits[4] = {real(above & 1), real(above >> 1 & 1), real(below & 1), real(below >> 1 & 1)};
    return blend(bits, p.x, p.y);
}

// The bilinear mean of a map of N x N bytes, of points of which it begins at some bytes
template <int N>
static inline Lanes bytes_at(const uint8_t *seen, Ints from, Lanes a, Lanes b) {
    const Place p = place(a, b, N);
    const Ints byte = clamp(p.column, N - 4), shift = 8 * (p.column - byte);
    const Ints first = from + p.row * N + byte;
    const Ints above = gather_bytes(seen, first) >> shift, below = gather_bytes(seen, first + N) >> shift;
    const Lanes shares[4] = {real(above & BYTE), real(above >> 8 & BYTE), real(below & BYTE), real(below >> 8 & BYTE)};
    return blend(shares, p.x, p.y) * (1.0f / BYTE);
}

// ptt.ops.hemispheres.visible
static inline Lanes visible(const uint8_t *seen, const Layout &of, Ints from, Lanes a, Lanes b, Lanes level) {
    const Lanes at = (level - 1.0f) * 0.25f, wide = least(most(at, all(0)), all(1));
    const Lanes widest = least(most(2.0f * at - 2.0f, all(0)), all(1));
    Lanes through = all(0);
    if (any(wide < 1)) through = bits_at(seen, of.bits, from, a, b);
    if (any((wide > 0) & (widest < 1))) through += wide * (bytes_at<WIDE_SIDE>(seen, from + of.wide, a, b) - through);
    if (any(widest > 0)) through += widest * (bytes_at<WIDEST_SIDE>(seen, from + of.widest, a, b) - through);
    return through;
}

// A place between which points lie: the first of its bytes, how much it counts, and its frame.
struct Corner {
    Ints from;
    Lanes weight, frame[9];
};

// The frames of places, from rows of them.
static inline void frames_at(const float *frames, Ints row, Lanes *frame) {
    for (int i = 0; i < 8; i += 4) gather_four(frames + i, 9 * row, frame + i);
    frame[8] = gather(frames + 8, 9 * row);
}

// The height of a direction in the world above the horizon of a normal, and how much that counts: in full from RISEN on.
static inline Lanes risen(const Lanes *normal, const Lanes *d, float rise, Lanes &height) {
    height = normal[0] * d[0] + normal[1] * d[1] + normal[2] * d[2];
    return least(most(height * rise, all(0)), all(1));
}

// The local direction of one in the world, as (a, b).
static inline void local_at(const Lanes *frame, const Lanes *d, Lanes height, Lanes &a, Lanes &b) {
    const Lanes local[3] = {frame[0] * d[0] + frame[1] * d[1] + frame[2] * d[2],
                            frame[3] * d[0] + frame[4] * d[1] + frame[5] * d[2], height};
    hemi_octahedral(local, a, b);
}
