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

// expand: S[b, c, x, w] unit[b] = sum over e of  A[cluster[b], c, e, x] W[b, e, w], rounded to 16 bits, and laid out in
// blocks of GROUP points, so that the view step reads it in one line.
// Of a tile, in rows x and in vectors of w: 24 sums fill 32 registers, 12 fill 16; whole groups, whatever the lanes are.
constexpr int ROWS = 6, ACROSS = LANES == 8 ? 2 : 4;

template <int R>
static inline void expand_tile(const float *a, const float *w, Half *s, int64_t e, int64_t x, int64_t width,
                               int64_t group, float scale) {
    Lanes sum[R][ACROSS] = {};
    for (int64_t i = 0; i < e; ++i, a += x, w += width) {
        Lanes weight[ACROSS];
        for (int n = 0; n < ACROSS; ++n) weight[n] = load(w + n * LANES);
        for (int r = 0; r < R; ++r)
            for (int n = 0; n < ACROSS; ++n) sum[r][n] += a[r] * weight[n];
    }
    for (int r = 0; r < R; ++r)
        for (int n = 0; n < ACROSS; ++n)
            store(s + n * LANES / GROUP * group + r * GROUP + n * LANES % GROUP, scale * sum[r][n]);
}

// By the number of rows.
constexpr decltype(&expand_tile<1>) TILES[ROWS] = {expand_tile<1>, expand_tile<2>, expand_tile<3>,
                                                   expand_tile<4>, expand_tile<5>, expand_tile<6>};

// The largest of n absolute values.
static inline float largest(const float *p, int64_t n) {
    float found = 0;
#pragma omp simd reduction(max : found)
    for (int64_t i = 0; i < n; ++i) found = std::max(found, std::fabs(p[i]));
    return found;
}

// The largest sum over e of |W[e, w]|.
static inline float reach(const float *w, int64_t e, int64_t width) {
    float found = 0;
    for (int64_t at = 0; at < width; at += LANES) {
        Lanes sum = {};
        for (int64_t i = 0; i < e; ++i) sum += size(load(w + i * width + at));
        for (int l = 0; l < LANES; ++l) found = std::max(found, sum[l]);
    }
    return found;
}

extern "C" int32_t ptt_expand(const Expand *g) {
    static_assert(WIDTH % (ACROSS * LANES) == 0 && ACROSS * LANES % GROUP == 0, "blocks hold whole tiles, of whole groups");
    const int64_t e = g->factors, x = g->x, width = g->width, channels = g->channels, tiles = (x + ROWS - 1) / ROWS;
    in_parallel(g->blocks, g->threads, [=](int64_t b) {
        const float *own = g->eigen + g->cluster[b] * channels * e * x, *w = g->weights + b * e * width;
        // of what is largest: a float16 holds it, and the rest to 1e-9 of it
        const float most = std::max(largest(own, channels * e * x) * reach(w, e, width), TINY) / LARGEST_HALF;
        const int64_t group = channels * x * GROUP;
        std::fill(g->unit + b * width / GROUP, g->unit + (b + 1) * width / GROUP, most);
        for (int64_t at = 0; at < width; at += ACROSS * LANES)
            for (int64_t c = 0; c < channels; ++c)
                for (int64_t t = 0; t < tiles; ++t) {
                    const int64_t first = x * t / tiles, end = x * (t + 1) / tiles;
                    const float *a = own + c * e * x + first;
                    Half *s = g->out + (b * width + at) / GROUP * group + (c * x + first) * GROUP;
                    TILES[end - first - 1](a, w + at, s, e, x, width, group, 1 / most);
                }
    });
    return DONE;
}
