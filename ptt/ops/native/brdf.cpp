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
// Of a tile, in rows x and in vectors of w: 24 sums fill 32 registers, 12 fill 16; whole groups, whatever the lanes are.
constexpr int ROWS = 6, ACROSS = LANES == 8 ? 2 : 4;

template <int R>
static inline void expand_tile(const float *a, const float *w, int16_t *s, int64_t e, int64_t x, int64_t width,
                               int64_t group, const float *scale) {
    Lanes sum[R][ACROSS] = {};
    for (int64_t i = 0; i < e; ++i, a += x, w += width) {
        Lanes weight[ACROSS];
        for (int n = 0; n < ACROSS; ++n) weight[n] = load(w + n * LANES);
        for (int r = 0; r < R; ++r)
            for (int n = 0; n < ACROSS; ++n) sum[r][n] += a[r] * weight[n];
    }
    for (int r = 0; r < R; ++r)
        for (int n = 0; n < ACROSS; ++n)
            store(s + n * LANES / GROUP * group + r * GROUP + n * LANES % GROUP, scale[r] * sum[r][n]);
}

// By the number of rows.
constexpr decltype(&expand_tile<1>) TILES[ROWS] = {expand_tile<1>, expand_tile<2>, expand_tile<3>,
                                                   expand_tile<4>, expand_tile<5>, expand_tile<6>};

// The largest |W[e, w]| over w of each e.
static inline void reach(const float *w, int64_t e, int64_t width, float *most) {
    for (int64_t i = 0; i < e; ++i, w += width) {
        Lanes found = {};
        for (int64_t at = 0; at < width; at += LANES) found = ::most(found, size(load(w + at)));
        most[i] = 0;
        for (int l = 0; l < LANES; ++l) most[i] = std::max(most[i], found[l]);
    }
}

// What no sum of a row leaves: sum over e of |A[e, x]| most[e], as units and as what divides by them.
static inline void units(const float *a, const float *most, int64_t e, int64_t x, float *unit, float *scale) {
    std::fill(unit, unit + x, TINY * LARGEST_WORD);
    for (int64_t i = 0; i < e; ++i)
        for (int64_t r = 0; r < x; ++r) unit[r] += std::fabs(a[i * x + r]) * most[i];
    for (int64_t r = 0; r < x; ++r) unit[r] /= LARGEST_WORD, scale[r] = 1 / unit[r];
}

extern "C" int32_t ptt_expand(const Expand *g) {
    static_assert(WIDTH % (ACROSS * LANES) == 0 && ACROSS * LANES % GROUP == 0, "blocks hold whole tiles, of whole groups");
    const int64_t e = g->factors, x = g->x, width = g->width, channels = g->channels, tiles = (x + ROWS - 1) / ROWS;
    in_parallel(g->blocks, g->threads, [=](int64_t b) {
        const float *own = g->eigen + g->cluster[b] * channels * e * x, *w = g->weights + b * e * width;
        const int64_t group = channels * x * GROUP, groups = width / GROUP;
        std::vector<float> most(e), scale(channels * x);
        reach(w, e, width, most.data());
        float *unit = g->unit + b * groups * channels * x;
        for (int64_t c = 0; c < channels; ++c) units(own + c * e * x, most.data(), e, x, unit + c * x, &scale[c * x]);
        for (int64_t k = 1; k < groups; ++k) std::copy(unit, unit + channels * x, unit + k * channels * x);
        for (int64_t at = 0; at < width; at += ACROSS * LANES)
            for (int64_t c = 0; c < channels; ++c)
                for (int64_t t = 0; t < tiles; ++t) {
                    const int64_t first = x * t / tiles, end = x * (t + 1) / tiles;
                    const float *a = own + c * e * x + first;
                    int16_t *s = g->out + (b * width + at) / GROUP * group + (c * x + first) * GROUP;
                    TILES[end - first - 1](a, w + at, s, e, x, width, group, &scale[c * x + first]);
                }
    });
    return DONE;
}
