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

// R rows of a tile. Each row of a group has the unit of its largest sum: with that of a bound, the sum of |A| times the
// largest |W|, rounding was five times as large on the engine, and with that of four groups it was a third larger.
template <int R>
static inline void expand_tile(const Expand &g, const float *a, const float *w, int16_t *values, float *unit) {
    constexpr int EACH = GROUP / LANES, GROUPS = ACROSS / EACH;
    Lanes sum[R][ACROSS] = {};
    for (int64_t i = 0; i < g.factors; ++i, a += g.x, w += g.width) {
        Lanes weight[ACROSS];
        for (int n = 0; n < ACROSS; ++n) weight[n] = load(w + n * LANES);
        for (int r = 0; r < R; ++r)
            for (int n = 0; n < ACROSS; ++n) sum[r][n] += a[r] * weight[n];
    }
    Lanes top[R * GROUPS + 3] = {};
    for (int r = 0; r < R; ++r)
        for (int n = 0; n < ACROSS; ++n) {
            Lanes &of_group = top[r * GROUPS + n / EACH];
            of_group = most(size(sum[r][n]), of_group);
        }
    Four own[(R * GROUPS + 3) / 4], scale[(R * GROUPS + 3) / 4];
    for (int i = 0; i < R * GROUPS; i += 4) {
        own[i / 4] = largest_of_four(top + i) * (1.0f / LARGEST_WORD) + TINY;
        scale[i / 4] = 1.0f / own[i / 4];
    }
    const int64_t rows = g.channels * g.x;
    for (int n = 0; n < GROUPS; ++n, unit += rows, values += rows * GROUP)
        for (int r = 0; r < R; ++r) {
            const int i = r * GROUPS + n;
            Lanes scaled[EACH];
            for (int e = 0; e < EACH; ++e) scaled[e] = scale[i / 4][i % 4] * sum[r][n * EACH + e];
            unit[r] = own[i / 4][i % 4];
            store_group(values + r * GROUP, scaled);
        }
}

// By the number of rows.
constexpr decltype(&expand_tile<1>) EXPAND[ROWS] = {expand_tile<1>, expand_tile<2>, expand_tile<3>,
                                                    expand_tile<4>, expand_tile<5>, expand_tile<6>};

extern "C" int32_t ptt_expand(const Expand *g) {
    static_assert(WIDTH % (ACROSS * LANES) == 0 && WIDTH % GROUP == 0, "blocks hold whole tiles, and whole groups");
    const int64_t x = g->x, channels = g->channels, tiles = (x + ROWS - 1) / ROWS;
    in_parallel(g->blocks, g->threads, [=](int64_t b) {
        const float *own = g->eigen + g->cluster[b] * channels * g->factors * x;
        const float *w = g->weights + b * g->factors * g->width;
        for (int64_t c = 0; c < channels; ++c)
            for (int64_t t = 0; t < tiles; ++t) {
                const int64_t first = x * t / tiles, end = x * (t + 1) / tiles;
                const float *a = own + c * g->factors * x + first;
                for (int64_t at = 0; at < g->width; at += ACROSS * LANES) {
                    const int64_t row = (b * g->width + at) / GROUP * channels * x + c * x + first;
                    EXPAND[end - first - 1](*g, a, w + at, g->out + row * GROUP, g->unit + row);
                }
            }
    });
    return DONE;
}
