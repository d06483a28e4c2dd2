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

// The bilinear mean of a map of N x N bytes, of points of which it begins at some bytes, and how it changes along a and b
template <int N>
static inline Lanes bytes_at(const uint8_t *seen, Ints from, Lanes a, Lanes b, Lanes *slope) {
    constexpr float half = 0.5f * N, unit = 1.0f / BYTE;
    const Place p = place(a, b, N);
    const Ints byte = clamp(p.column, N - 4), shift = 8 * (p.column - byte);
    const Ints first = from + p.row * N + byte;
    const Ints above = gather_bytes(seen, first) >> shift, below = gather_bytes(seen, first + N) >> shift;
    const Lanes shares[4] = {real(above & BYTE), real(above >> 8 & BYTE), real(below & BYTE), real(below >> 8 & BYTE)};
    const Lanes above_by = shares[1] - shares[0], below_by = shares[3] - shares[2];
    const Lanes over = shares[0] + p.x * above_by, under = shares[2] + p.x * below_by;
    const Lanes x = (a + 1.0f) * half - 0.5f, y = (b + 1.0f) * half - 0.5f;
    slope[0] = (x >= 0) & (x <= (float)(N - 1)) ? (above_by + p.y * (below_by - above_by)) * (half * unit) : all(0);
    slope[1] = (y >= 0) & (y <= (float)(N - 1)) ? (under - over) * (half * unit) : all(0);
    return (over + p.y * (under - over)) * unit;
}

// Of lobes: the share that is seen, one of wide lobes about the same axes, and the gradient of that.
struct Share {
    Lanes seen, smooth, gradient[3];
};

// ptt.ops.hemispheres._seen, about directions d that lie at (a, b)
static inline Share share_of(
    const uint8_t *seen, const Layout &of, Ints from, const Lanes *d, Lanes a, Lanes b, Lanes level) {
    const Lanes at = (level - 1.0f) * 0.25f, wide = least(most(at, all(0)), all(1));
    const Lanes widest = least(most(2.0f * at - 2.0f, all(0)), all(1));
    Share s = {all(0), all(0), {}};
    Lanes slope[2] = {};
    if (any(wide < 1)) s.seen = bits_at(seen, of.bits, from, a, b);
    if (any((wide > 0) & (widest < 1))) {
        s.smooth = bytes_at<WIDE_SIDE>(seen, from + of.wide, a, b, slope);
        s.seen += wide * (s.smooth - s.seen);
    }
    if (any(widest > 0)) {
        Lanes other[2];
        const Lanes share = bytes_at<WIDEST_SIDE>(seen, from + of.widest, a, b, other);
        s.seen += widest * (share - s.seen), s.smooth += widest * (share - s.smooth);
        for (int i = 0; i < 2; ++i) slope[i] += widest * (other[i] - slope[i]);
    }
    const Lanes along = slope[0] * a + slope[1] * b, one = all(1);
    const Lanes scale = 1.0f / most(size(d[0]) + size(d[1]) + size(d[2]), all(TINY));
    s.gradient[0] = (slope[0] + slope[1] - along * signed_as(one, d[0])) * scale;
    s.gradient[1] = (slope[0] - slope[1] - along * signed_as(one, d[1])) * scale;
    s.gradient[2] = -along * signed_as(one, d[2]) * scale;
    return s;
}

// How far, along the gradient of the share of lobes, the mean directions of the parts lie that are seen, and against it
// of those that are hidden (ptt.ops.hemispheres._split); sharpness: the inverse variance of a lobe of level 1.
static inline void parts_of(const Share &s, Lanes level, float sharpness, Lanes &seen, Lanes &hidden) {
    const Lanes octaves = (Lanes)whole((level + 126.0f) * 0x1p23f);  // 2^(level - 1), linear between whole levels
    const Lanes variance = octaves * (1.0f / sharpness) * least(most((level - 1.0f) * 0.5f, all(0)), all(1));
    const Lanes *g = s.gradient, square = g[0] * g[0] + g[1] * g[1] + g[2] * g[2];
    const Lanes furthest = FURTHEST * root(most(variance, all(TINY))) / root(most(square, all(TINY)));
    seen = least(variance / most(s.smooth, all(LEAST_SHARE)), furthest);
    hidden = least(variance / most(1.0f - s.smooth, all(LEAST_SHARE)), furthest);
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

// The local direction of one in the world.
static inline void local_at(const Lanes *frame, const Lanes *d, Lanes height, Lanes *local) {
    local[0] = frame[0] * d[0] + frame[1] * d[1] + frame[2] * d[2];
    local[1] = frame[3] * d[0] + frame[4] * d[1] + frame[5] * d[2];
    local[2] = height;
}
