// The BRDF step of ptt/ops/relight.py.

#include "lanes.h"

#include <vector>

// R eigen-points from v on, of cluster and channel kc.
template <int R>
static inline void eigen_rows(const Eigen &g, int64_t kc, int64_t v, const float *second) {
    const int64_t c = kc % 3, i = g.factors, first = kc * g.eigen + v, terms = g.slots || g.again ? HARMONICS : 0;
    float light[R][HARMONICS];
    for (int r = 0; r < R; ++r)
        for (int s = 0; s < HARMONICS; s += LANES) {
            Lanes sum = {};
            for (int64_t q = 0; q < g.slots; ++q)
                sum += g.h[c * g.slots + q] * load(g.one + ((kc * g.slots + q) * g.eigen + v + r) * HARMONICS + s);
            store(light[r] + s, sum);
        }
    for (int r = 0; r < R; ++r) light[r][0] += second[v + r];
    for (int64_t n = 0; n < g.width; n += LANES) {
        Lanes sum[R] = {};
        for (int64_t f = 0; f < i; ++f) {
            const Lanes table = load(g.from_direct + (c * i + f) * g.padded + n);
            for (int r = 0; r < R; ++r) sum[r] += g.direct[(first + r) * i + f] * table;
        }
        for (int64_t s = 0; s < terms; ++s) {
            const Lanes table = load(g.from_light + (c * HARMONICS + s) * g.padded + n);
            for (int r = 0; r < R; ++r) sum[r] += light[r][s] * table;
        }
        const int64_t size = std::min<int64_t>(LANES, g.width - n) * sizeof(float);
        for (int r = 0; r < R; ++r) std::memcpy(g.out + (first + r) * g.width + n, &sum[r], size);
    }
}

extern "C" int32_t ptt_eigen(const Eigen *g) {
    in_parallel(3 * g->clusters, g->threads, [&](int64_t kc) {
        std::vector<float> second(g->eigen);
        for (int64_t p = 0; p < g->again; ++p)
            for (int64_t v = 0; v < g->eigen; ++v)
                second[v] += g->pairs[kc % 3 * g->again + p] * g->two[(kc * g->again + p) * g->eigen + v];
        int64_t v = 0;
        for (; v + 4 <= g->eigen; v += 4) eigen_rows<4>(*g, kc, v, second.data());
        for (; v < g->eigen; ++v) eigen_rows<1>(*g, kc, v, second.data());
    });
    return DONE;
}

// expand: S[b, c, x, w] unit[b, c, x] = sum over e of  A[cluster[b], c, e, x] W[b, e, w], rounded to 16 bits, and laid
// out in blocks of GROUP points, so that the view step reads it in one line.
// Of a tile, in rows x and in vectors of w: 24 sums fill 32 registers, 12 fill 16.
constexpr int ROWS = 6, ACROSS = LANES == 8 ? 2 : 4;

// The sums (R, width) of a tile, and the largest ones of each lane so far.
template <int R>
static inline void expand_tile(const Expand &g, const float *a, const float *w, float *sums, Lanes *top) {
    Lanes sum[R][ACROSS] = {};
    for (int64_t i = 0; i < g.factors; ++i, a += g.x, w += g.width) {
        Lanes weight[ACROSS];
        for (int n = 0; n < ACROSS; ++n) weight[n] = load(w + n * LANES);
        for (int r = 0; r < R; ++r)
            for (int n = 0; n < ACROSS; ++n) sum[r][n] += a[r] * weight[n];
    }
    for (int r = 0; r < R; ++r)
        for (int n = 0; n < ACROSS; ++n) {
            store(sums + r * g.width + n * LANES, sum[r][n]);
            top[r] = most(size(sum[r][n]), top[r]);
        }
}

// R rows of a block. A row's unit is that of its largest sum: with that of a bound, the sum of |A| times the largest
// |W|, rounding was five times as large on the engine (and a sum of two lights off by 2.4e-5 for 1.4e-5).
template <int R>
static inline void expand_rows(const Expand &g, const float *a, const float *w, float *sums, int16_t *values,
                               float *unit) {
    Lanes top[R];
    for (Lanes &of_row : top) of_row = all(TINY * LARGEST_WORD);
    for (int64_t at = 0; at < g.width; at += ACROSS * LANES) expand_tile<R>(g, a, w + at, sums + at, top);
    float own[R], scale[R];
    for (int r = 0; r < R; ++r) own[r] = largest(top[r]) / LARGEST_WORD, scale[r] = 1 / own[r];
    const int64_t rows = g.channels * g.x;
    for (int64_t at = 0; at < g.width; at += GROUP, unit += rows, values += rows * GROUP) {
        std::copy(own, own + R, unit);
        for (int r = 0; r < R; ++r) {
            Lanes whole[GROUP / LANES];
            for (int n = 0; n < GROUP / LANES; ++n) whole[n] = scale[r] * load(sums + r * g.width + at + n * LANES);
            store_group(values + r * GROUP, whole);
        }
    }
}

// By the number of rows.
constexpr decltype(&expand_rows<1>) EXPAND[ROWS] = {expand_rows<1>, expand_rows<2>, expand_rows<3>,
                                                    expand_rows<4>, expand_rows<5>, expand_rows<6>};

extern "C" int32_t ptt_expand(const Expand *g) {
    static_assert(WIDTH % (ACROSS * LANES) == 0 && WIDTH % GROUP == 0, "blocks hold whole tiles, and whole groups");
    const int64_t x = g->x, channels = g->channels, tiles = (x + ROWS - 1) / ROWS;
    in_parallel(g->blocks, g->threads, [=](int64_t b) {
        const float *own = g->eigen + g->cluster[b] * channels * g->factors * x;
        const float *w = g->weights + b * g->factors * g->width;
        std::vector<float> sums(ROWS * g->width);
        for (int64_t c = 0; c < channels; ++c)
            for (int64_t t = 0; t < tiles; ++t) {
                const int64_t first = x * t / tiles, end = x * (t + 1) / tiles;
                const int64_t row = b * g->width / GROUP * channels * x + c * x + first;
                const float *a = own + c * g->factors * x + first;
                EXPAND[end - first - 1](*g, a, w, sums.data(), g->out + row * GROUP, g->unit + row);
            }
    });
    return DONE;
}
